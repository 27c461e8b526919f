"""The formats that viewers take, as methods and as codecs of Gaussian models."""

__version__ = "0.2.0"
