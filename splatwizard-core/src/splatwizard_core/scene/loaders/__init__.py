"""loaders room."""
