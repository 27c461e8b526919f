"""3D Gaussian Splatting, the baseline method of Splatwizard."""

__version__ = "0.3.0"
