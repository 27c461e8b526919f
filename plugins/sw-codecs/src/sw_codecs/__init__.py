"""Quantizers, entropy models, coders and position codecs for Splatwizard."""

__version__ = "0.3.0"
