"""Compiled rasterizers for CPU (C++) and CUDA, with shared maths headers."""

__version__ = "0.3.0"
