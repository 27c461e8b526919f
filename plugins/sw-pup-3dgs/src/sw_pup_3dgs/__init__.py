"""PUP 3D-GS: what the training views hardly constrain goes, in two rounds (arXiv 2406.10219)."""

__version__ = "0.3.0"
