"""The tests of this folder share `wisp_scenes`; pytest's importlib mode puts no folder on the path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from sw_kit.toy_scene import make, one_thread, plugins, rasterizer, toy

__all__ = ["make", "one_thread", "plugins", "rasterizer", "toy"]
