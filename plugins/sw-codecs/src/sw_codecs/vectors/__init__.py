"""Coders of float vectors that lose more where it matters less."""
