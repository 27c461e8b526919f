"""An anchor method that holds the core to its contracts."""
