"""Scene models: explicit Gaussians, what every model hands to a rasterizer, and the .ply of 3DGS."""
