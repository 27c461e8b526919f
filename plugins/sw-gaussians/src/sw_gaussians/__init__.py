"""Training of explicit Gaussians: the 3DGS stage, density controls (ADC, MCMC, budget), and fine-tuning."""
