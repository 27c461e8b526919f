"""Faster functions of the same signatures as the plain ones, each held against its plain one by a test."""
