"""Pictures and maps of decoded scenes: depth, normals, alpha, as files."""

__version__ = "0.2.0"
