"""MesonGS: post-training compression of 3D Gaussians by efficient attribute transformation."""
