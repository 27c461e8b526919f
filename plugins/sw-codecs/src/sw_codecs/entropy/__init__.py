"""Entropy models: a rate estimate for training and the coded bytes that agree with it."""
