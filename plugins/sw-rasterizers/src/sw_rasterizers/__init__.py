"""Compiled rasterizers for Splatwizard: one C++ kernel family, vectorised and multi-threaded on the CPU."""

__version__ = "0.1.0"
