"""rendering room."""
