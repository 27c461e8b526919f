"""Opacity pruning, a method package for Splatwizard."""

__version__ = "0.1.0"
