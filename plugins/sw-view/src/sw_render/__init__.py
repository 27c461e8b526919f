"""Old import path of what draws pictures and maps in `sw_view`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

NAMES = (
    "agreement", "bake_command", "colors", "drawing", "exr", "films", "map_files", "maps", "modes", "trajectory",
    "video", "views",
)  # fmt: skip

forward(__name__, "sw_view", {"command": "sw_view.render_command", **{name: f"sw_view.{name}" for name in NAMES}})
