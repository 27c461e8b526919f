"""Quantizers: a differentiable surrogate for training and exact symbols for the file, in one object."""
