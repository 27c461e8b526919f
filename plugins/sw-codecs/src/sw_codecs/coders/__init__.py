"""Entropy coders and the probability models that they take."""
