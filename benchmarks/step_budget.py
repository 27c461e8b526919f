"""Budget of a training step of 3DGS on a GPU: phases of the device, gaps in which it waits for the host, and variants.

    python benchmarks/step_budget.py [--sizes 2000@64x48,250000@799x532,1000000@799x532] [--steps 120]

Every variant trains the synthetic scene of benchmarks/scene.py, drawn by itself with other colours, without
densification, so that all have the same Gaussians; statistics are collected, as in the first half of the plan. Variants
take turns, three times each; a step's wall clock is the least of them. Then some steps are watched by torch.profiler,
which slows the host: busy time of phases, launches and the host's waits are of those. gap = wall - busy: the device had
nothing to do. The first size has next to nothing for the device: its wall clock is what the host takes for a step.

dense           preset `paper`
fused           spherical harmonics updated in the backward pass (`fused_updates`)
sparse          sparse_adam=true
deterministic   deterministic=true: sums in one order
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from contextlib import AbstractContextManager
from typing import Any

import torch
from scene import make_arrays, orbit_cameras
from sw_gaussians.stage import ThreeDGSStage
from torch.profiler import ProfilerActivity, profile

from splatwizard_core.base.random_states import seeded
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.images import keep_pictures
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import Streams
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from sw_3dgs.config import ThreeDGSConfig

TENSORS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
SIZES = "2000@64x48,250000@799x532,1000000@799x532"
VIEWS, ROUNDS, WARM_UP = 24, 3, 60
# The plan of the first half, but for what changes the number of Gaussians.
PLAN: dict[str, Any] = {"density": {"settings": {"start": 14_000, "stop": 15_000, "reset_interval": 15_000}}}
VARIANTS: dict[str, dict[str, Any]] = {
    "dense": {}, "fused": {}, "sparse": {"sparse_adam": True}, "deterministic": {},
}  # fmt: skip
# Part of a kernel's name -> phase; the first that fits.
PHASES = (
    ("project_backward_kernel", "gradients of inputs"), ("project_kernel", "project"), ("shade_kernel", "shade"),
    ("sum_groups", "blend backward"), ("photometric", "loss"), ("splatwizard::cuda", ""), ("emit_kernel", "emit"),
    ("find_tiles", "emit"), ("number_kernel", "blend backward"), ("Radix", "sort"), ("radix", "sort"),
    ("few_kernel", "blend"), ("split_kernel", "blend"), ("blend_kernel", "blend"),
    ("backward_kernel", "blend backward"),
    ("Memset", "clears and copies"), ("Memcpy", "clears and copies"), ("fill", "clears and copies"),
)  # fmt: skip
OF_TRAINING = (
    ("adam", "Adam"), ("statistics", "statistics"), ("forward_kernel", "loss"), ("backward_kernel", "loss")
)  # fmt: skip


def phase_of(kernel: str) -> str:
    """The phase that a kernel, copy or fill belongs to; torch's own are activations, pictures and small sums."""
    for part, phase in PHASES:
        if part in kernel:
            return phase or next((name for piece, name in OF_TRAINING if piece in kernel), "torch operations")
    return "torch operations"


def scene_of(n: int, width: int, height: int, device: str) -> tuple[GaussianModel, Scene, float]:
    """The model, views of it whose colours are a little off, so that every gradient is alive, and who is visible."""
    t = {name: torch.from_numpy(a) for name, a in make_arrays(n).items()}
    raw = (t["means"], t["sh"][:, :1], t["sh"][:, 1:], t["opacities"].logit(), t["scales"].log(), t["quats"])
    model = GaussianModel.from_tensors(*raw).to(device)
    rasterizer, views, visible = NegotiatedRasterizer(load_plugins(), device=device), [], []
    with torch.no_grad():
        for i, camera in enumerate(orbit_cameras(VIEWS, width, height)):
            moved = camera.to(device)
            result = rasterizer.render(model.gaussians(moved, rasterizer), moved, RasterOptions())
            visible.append(float(result.visible.float().mean()))
            pixels = (255 * (0.9 * result.image + 0.05).clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()
            views.append(View(camera, f"{i}.png", lambda pixels=pixels: pixels))
    points = PointCloud(torch.zeros(1, 3))
    return model, Scene("synthetic", views, views[:1], points, Protocol("synthetic")), visible[0]


def setting(variant: str) -> AbstractContextManager[None]:
    """Return the block that a variant's steps run in."""
    return seeded(0, deterministic=variant == "deterministic")


def trainer_of(variant: str, model: GaussianModel, scene: Scene, device: str) -> Trainer:
    config = ThreeDGSConfig.model_validate({**PLAN, **VARIANTS[variant]})
    stage = ThreeDGSStage(config, fuses_updates=variant == "fused")
    ppl, streams = PipelineParams(device=device), Streams(0)
    rasterizer = NegotiatedRasterizer(load_plugins(), device=device)
    copy = GaussianModel.from_tensors(*(getattr(model, name).detach() for name in TENSORS)).to(device)
    context = StageContext(copy, scene, ppl, rasterizer, streams, lambda name: copy)
    return Trainer(TrainingState.begin(stage, stage.begin(context), scene, ppl, rasterizer, streams))


def wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def wall(trainer: Trainer, steps: int, device: str) -> float:
    """Milliseconds a step."""
    wait(device)
    since = time.perf_counter()
    trainer.run(trainer.state.step + steps, lambda record: None)
    wait(device)
    return 1e3 * (time.perf_counter() - since) / steps


def watched(trainer: Trainer, steps: int) -> tuple[dict[str, float], float, float]:
    """Milliseconds a step of each phase, launches a step, and milliseconds a step in which the host waited."""
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA]
    with profile(activities=activities) as found:
        trainer.run(trainer.state.step + steps, lambda record: None)
        torch.cuda.synchronize()
    phases: dict[str, float] = defaultdict(float)
    launches, waited = 0, 0.0
    for event in found.key_averages():
        if str(event.device_type).endswith("CUDA"):
            phases[phase_of(event.key)] += event.self_device_time_total / steps / 1e3
            launches += event.count
        elif event.key in ("cudaEventSynchronize", "cudaStreamSynchronize"):
            waited += event.self_cpu_time_total / steps / 1e3
    return phases, launches / steps, waited


def measure(n: int, width: int, height: int, args: argparse.Namespace) -> None:
    model, scene, share = scene_of(n, width, height, args.device)
    keep_pictures(scene.train, args.device)
    names = args.variants.split(",")
    trainers = {name: trainer_of(name, model, scene, args.device) for name in names}
    least = dict.fromkeys(names, float("inf"))
    for name in names:
        with setting(name):
            trainers[name].run(WARM_UP, lambda record: None)
    for _ in range(ROUNDS):
        for name in names:
            with setting(name):
                least[name] = min(least[name], wall(trainers[name], args.steps, args.device))
    print(f"{n:,} Gaussians, {width}x{height}, {100 * share:.0f} % visible in the first view, ms per step")
    for name in names:
        print(f"  {name:14} wall {least[name]:6.3f}   {least[name] / least[names[0]]:5.2f} of {names[0]}")
    if args.device != "cuda":
        return
    table: dict[str, dict[str, float]] = {}
    for name in names:
        with setting(name):
            phases, launches, waited = watched(trainers[name], min(args.steps, 60))
        busy = sum(phases.values())
        table[name] = {**phases, "busy": busy, "gap": max(0.0, least[name] - busy), "host waited (profiled)": waited}
        table[name]["launches a step"] = launches
    rows = list(dict.fromkeys(row for column in table.values() for row in sorted(column, key=lambda r: -column[r])))
    last = ["busy", "gap", "host waited (profiled)", "launches a step"]
    print(f"  {'':24} " + " ".join(f"{name:>13}" for name in names))
    for row in [*(r for r in rows if r not in last), *last]:
        print(f"  {row:24} " + " ".join(f"{table[name].get(row, 0.0):13.3f}" for name in names), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default=SIZES, help="Gaussians and picture, N@WIDTHxHEIGHT (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument(
        "--variants", default=",".join(VARIANTS), help=f"of {', '.join(VARIANTS)}; the first is the base"
    )
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("torch sees no CUDA device here")
    for size in args.sizes.split(","):
        n, width, height = map(int, size.replace("@", "x").split("x"))
        measure(n, width, height, args)


if __name__ == "__main__":
    main()
