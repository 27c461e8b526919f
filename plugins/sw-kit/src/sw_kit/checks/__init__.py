"""The checks: of a package as it is registered, of what its targets are, and of what they do."""
