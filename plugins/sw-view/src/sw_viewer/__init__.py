"""Old import path of the viewer in `sw_view`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

NAMES = (
    "after_run", "entries", "exhibits", "frames", "live", "looks", "packing", "page_file", "shown_cameras",
    "shown_gaussians", "viewer", "visitor",
)  # fmt: skip

forward(__name__, "sw_view", {"command": "sw_view.view_command", **{name: f"sw_view.{name}" for name in NAMES}})
