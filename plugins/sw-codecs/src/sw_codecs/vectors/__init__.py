"""Coders of float vectors with loss, by codebooks."""
