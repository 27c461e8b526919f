"""gaussians room."""
