"""TrimGS: Gaussians trimmed by what they contribute and split by their size (arXiv 2406.07499)."""

__version__ = "0.3.0"
