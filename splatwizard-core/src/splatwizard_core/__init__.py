"""Splatwizard: a benchmark toolkit for 3D Gaussian Splatting compression. The core knows no method."""

__version__ = "0.2.0"
