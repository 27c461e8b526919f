"""Training explicit Gaussians: the 3DGS stage, density control and MCMC of Splatwizard."""
