"""Old import path of the viewer in `sw_view`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

NAMES = (
    "after_run", "entries", "frames", "live", "packing", "page_file", "shown_cameras", "shown_gaussians", "viewer",
)  # fmt: skip

RENAMED = {
    "command": "view_command", "exhibits": "shown_models", "looks": "mode_pictures", "visitor": "browser_session",
}  # fmt: skip

MOVED = {**{name: name for name in NAMES}, **RENAMED}
forward(__name__, "sw_view", {old: f"sw_view.{new}" for old, new in MOVED.items()})
