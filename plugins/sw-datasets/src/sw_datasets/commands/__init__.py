"""The command `sw data`."""
