"""A toy scene, and few Gaussians whose scores can be worked out by hand."""

from sw_kit.toy_scene import make, one_thread, plugins, rasterizer, toy

__all__ = ["make", "one_thread", "plugins", "rasterizer", "toy"]
