"""CAT-3DGS: anchors under a triplane context, autoregressive over channels."""

__version__ = "0.3.0"
