"""HAC: hash-grid assisted context for 3D Gaussian Splatting compression, as a method of Splatwizard."""

__version__ = "0.3.0"
