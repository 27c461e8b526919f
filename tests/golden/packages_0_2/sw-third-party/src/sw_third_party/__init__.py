"""Opacity pruning for Splatwizard: drops the most transparent Gaussians of a trained 3DGS scene and trains on."""

__version__ = "0.1.0"
