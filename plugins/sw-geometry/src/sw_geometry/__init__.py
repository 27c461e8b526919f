"""Meshes of Gaussian scenes by depth fusion, and how far they are from the truth."""
