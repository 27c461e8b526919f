"""Old import path of the methods and codecs in `sw_interchange`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

NAMES = ("codecs", "methods")

forward(__name__, "sw_interchange", {name: f"sw_interchange.{name}" for name in NAMES})
