"""Splatwizard: a benchmark toolkit for 3D Gaussian Splatting compression. The core knows no method."""

from splatwizard_native import lend

__version__ = "0.3.0"
__all__, __getattr__ = lend(__name__, {"steps": "decode encode evaluate load_scene render run train"})
