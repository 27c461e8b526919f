"""Compiled rasterizers for Splatwizard: one C++ and CUDA kernel family, its mathematics shared."""

__version__ = "0.3.0"
