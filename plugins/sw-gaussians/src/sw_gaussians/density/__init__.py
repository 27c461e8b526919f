"""Density controls (adc, mcmc, budget), one file each, and their shared helpers."""

from sw_gaussians.density.adc import AdaptiveDensityControl, densify_and_prune, reset_opacity
from sw_gaussians.density.splitting import rotate, split_children

__all__ = ["AdaptiveDensityControl", "densify_and_prune", "reset_opacity", "rotate", "split_children"]
