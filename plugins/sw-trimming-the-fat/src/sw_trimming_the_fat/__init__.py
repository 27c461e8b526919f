"""Trimming the Fat: what is faint and hardly moves the pictures goes, in ten small steps (arXiv 2406.18214)."""

__version__ = "0.3.0"
