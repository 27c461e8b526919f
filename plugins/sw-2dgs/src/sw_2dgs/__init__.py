"""2D Gaussian Splatting (2DGS) for Splatwizard: surfels that form a surface."""

__version__ = "0.3.0"
