"""Wisp: explicit splats in one small, exact file."""

__version__ = "0.3.0"
