"""3D Gaussian Splatting, the baseline method of Splatwizard, and its densification tasks."""

__version__ = "0.2.0"
