"""Speedy-Splat: Gaussians that the pictures do not depend on go while the scene trains (arXiv 2412.00578)."""
