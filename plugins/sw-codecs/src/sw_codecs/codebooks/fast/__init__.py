"""Faster functions of the same signatures as the plain ones."""
