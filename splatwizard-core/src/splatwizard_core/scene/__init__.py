"""Cameras, views, scenes, and the contract of the data sets that read them."""
