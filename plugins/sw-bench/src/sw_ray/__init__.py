"""Old import path of the Ray executor in `sw_bench`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

forward(__name__, "sw_bench", {"executor": "sw_bench.ray_cluster", "work": "sw_bench.ray_work"})
