"""The procedural scene."""
