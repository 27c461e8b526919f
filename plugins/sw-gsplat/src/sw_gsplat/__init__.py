"""The public gsplat rasterizer behind Splatwizard's protocol."""

__version__ = "0.2.0"
