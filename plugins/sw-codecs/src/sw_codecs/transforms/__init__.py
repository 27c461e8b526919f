"""Transforms of attributes before they are quantized: RAHT over an octree, rotations as angles."""
