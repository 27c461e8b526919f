"""Compact3DGS: masked Gaussians with colours of a hash grid and shapes of codebooks, as a method of Splatwizard."""

__version__ = "0.3.0"
