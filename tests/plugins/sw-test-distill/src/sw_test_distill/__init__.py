"""A two-stage method that holds the core to its contracts."""
