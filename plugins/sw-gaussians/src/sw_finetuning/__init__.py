"""Old import path of `sw_gaussians.finetune`, kept for one release."""

from splatwizard_core.plugins.forwarding import forward

NAMES = ("distillation", "fine_tuning", "importance", "pruning", "volume")

forward(__name__, "sw_gaussians.finetune", {name: f"sw_gaussians.finetune.{name}" for name in NAMES})
