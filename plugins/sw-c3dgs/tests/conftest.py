"""Plugins, the rasterizer and scenes of a few Gaussians and pixels."""

from sw_kit.toy_scene import make, one_thread, plugins, rasterizer, toy

__all__ = ["make", "one_thread", "plugins", "rasterizer", "toy"]
