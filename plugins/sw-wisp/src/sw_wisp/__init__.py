"""Wisp: explicit Gaussians in one small file, each coded as what the ones before it do not tell, for Splatwizard."""

__version__ = "0.3.0"
