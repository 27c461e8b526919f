"""The public gsplat rasterizer behind Splatwizard's protocol."""

__version__ = "0.3.0"
