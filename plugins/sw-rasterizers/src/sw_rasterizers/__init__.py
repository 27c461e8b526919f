"""Compiled rasterizers, fused SSIM and Adam for Splatwizard, CPU and CUDA."""

__version__ = "0.1.0"
