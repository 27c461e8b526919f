"""native room."""
