"""C3DGS: codebooks of colours and shapes, made by sensitivity and trained through 8-bit quantizers."""

__version__ = "0.3.0"
