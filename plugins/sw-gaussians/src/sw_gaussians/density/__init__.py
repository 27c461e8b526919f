"""Old import path of helpers of `adc` and `splitting`, until 0.4; density controls stand in one file each."""

from sw_gaussians.density.adc import AdaptiveDensityControl, densify_and_prune, reset_opacity
from sw_gaussians.density.splitting import rotate, split_children

__all__ = ["AdaptiveDensityControl", "densify_and_prune", "reset_opacity", "rotate", "split_children"]
