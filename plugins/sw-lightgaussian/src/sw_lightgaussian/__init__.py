"""LightGaussian: prune by global significance, distil into fewer SH bands, vector-quantise what matters least."""

__version__ = "0.3.0"
