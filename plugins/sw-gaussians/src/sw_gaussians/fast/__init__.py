"""Faster ways to the same result: delete this folder, and what chooses them takes the plain functions."""
