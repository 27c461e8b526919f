"""Pictures, maps and videos of decoded scenes, a viewer in the browser, and one HTML file that needs no server."""

__version__ = "0.3.0"
