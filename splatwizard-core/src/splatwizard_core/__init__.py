"""Splatwizard: a benchmark toolkit for 3D Gaussian Splatting compression. The core knows no method."""

from splatwizard_native import lazy_exports

__version__ = "0.3.0"
__all__, __getattr__ = lazy_exports(__name__)
