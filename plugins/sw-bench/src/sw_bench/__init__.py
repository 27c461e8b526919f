"""Sweeps over methods, scenes, rate points and seeds: planned, run anywhere, resumed, and told as one table."""

__version__ = "0.3.0"
