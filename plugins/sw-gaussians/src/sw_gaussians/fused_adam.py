"""Old import path of `sw_gaussians.fast.fused_adam`, for one release."""

import warnings

from sw_gaussians.fast.fused_adam import OFFERED, FusingOptimizer

__all__ = ["OFFERED", "FusingOptimizer"]
warnings.warn("sw_gaussians.fused_adam is sw_gaussians.fast.fused_adam now", DeprecationWarning, stacklevel=2)
