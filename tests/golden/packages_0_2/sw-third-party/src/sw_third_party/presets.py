"""Named configurations, and the rate points: r1 is the smallest file."""

PRESETS = {
    # The published values, which are the defaults.
    "paper": {},
    # For a CPU and the demo scene: few steps, and larger ones.
    "quick": {
        "iterations": 500,
        "lr.position_init": 8e-6,
        "lr.position_final": 8e-6,
        "lr.sh_dc": 1e-2,
        "lr.sh_rest": 1e-3,
        "lr.scales": 1e-2,
        "lr.quats": 2e-3,
    },
}

RATES = {"r1": {"keep": 0.25}, "r2": {"keep": 0.5}, "r3": {"keep": 0.75}}
DEFAULT_RATE = "r2"
