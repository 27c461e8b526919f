"""Codecs of whole Gaussian models: a method that only prunes needs no file format of its own."""
