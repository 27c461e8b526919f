"""Diagnosis of a machine: each part is tried, and what does not work comes with the line that mends it."""
