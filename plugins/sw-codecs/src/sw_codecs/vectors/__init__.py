"""Coders of float vectors with loss."""
