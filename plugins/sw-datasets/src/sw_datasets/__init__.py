"""Loaders of COLMAP and Blender scenes, six published data sets and the procedural demo scene, for Splatwizard."""
