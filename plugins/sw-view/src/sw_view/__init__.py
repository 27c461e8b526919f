"""Decoded scenes in the browser: drawn by a server, or in one HTML file that needs none."""

__version__ = "0.2.0"
