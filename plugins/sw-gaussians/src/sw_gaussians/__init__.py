"""Training explicit Gaussians: the stage of 3DGS, its density control, and that of 3DGS-MCMC."""
