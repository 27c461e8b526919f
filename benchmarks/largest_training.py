"""Speed and memory of training 3DGS by the number of Gaussians, up to where one GPU ends.

    python benchmarks/largest_training.py --sizes 100000,1000000,5000000,20000000,60000000 --out out/largest.jsonl

Gaussians fill a cube evenly, and cameras in its middle look outwards: each sees about a tenth of them, as in a large
scene. Pictures are noise, so that gradients stay alive, and what is seen grows at two densifications: memory is the
peak of torch's allocator over them, per Gaussian of the end. Steps a second are those after the densifications, of
preset `paper`. Where memory does not suffice, that is printed, and the larger sizes are left out.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import time
from pathlib import Path
from typing import Any

import torch

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.images import keep_pictures
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import Streams
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from sw_3dgs.config import ThreeDGSConfig
from sw_3dgs.method import ThreeDGS

VIEWS, TIMED = 24, 30
PLAN: dict[str, Any] = {"density": {"settings": {"start": 20, "stop": 45, "interval": 20, "reset_interval": 15_000}}}
AFTER = 50  # steps before the clock starts, the densifications at 20 and 40 among them


def model_of(n: int, device: str) -> GaussianModel:
    """Return n Gaussians in a cube of side 2, as large as the distance to their neighbours."""
    made = {"device": device, "generator": torch.Generator(device).manual_seed(n)}
    scale = math.log(0.6 * 2 / n ** (1 / 3))
    return GaussianModel.from_tensors(
        2 * torch.rand(n, 3, **made) - 1, torch.randn(n, 1, 3, **made), 0.05 * torch.randn(n, 15, 3, **made),
        torch.randn(n, **made), scale + 0.3 * torch.randn(n, 3, **made), torch.randn(n, 4, **made),
    )  # fmt: skip


def scene_of(width: int, height: int) -> Scene:
    """Return views from the middle of the cube."""
    views = []
    for i in range(VIEWS):
        angle = 2 * math.pi * i / VIEWS
        target = torch.tensor([math.cos(angle), 0.1 * math.sin(3 * angle), math.sin(angle)])
        up = torch.tensor([0.0, -1.0, 0.0])
        camera = Camera.look_at(0.1 * target, target, up, width=width, height=height, fov_x=1.1)
        noise = torch.randint(256, (height, width, 3), generator=torch.Generator().manual_seed(i), dtype=torch.uint8)
        views.append(View(camera, f"{i}.png", noise.numpy))
    return Scene("cube", views, views[:1], PointCloud(torch.zeros(1, 3)), Protocol("synthetic"))


def measure(n: int, scene: Scene, device: str) -> dict[str, Any]:
    """Return the figures of a training that begins with n Gaussians."""
    plugins, ppl, streams = load_plugins(), PipelineParams(device=device), Streams(0)
    (stage,) = ThreeDGS(plugins, ThreeDGSConfig.model_validate(PLAN)).stages()
    rasterizer = NegotiatedRasterizer(plugins, device=device)
    model = stage.begin(StageContext(model_of(n, device), scene, ppl, rasterizer, streams, _no_other))
    trainer = Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))
    trainer.run(AFTER, lambda _: None)
    synchronize(device)
    since = time.perf_counter()
    trainer.run(AFTER + TIMED, lambda _: None)
    synchronize(device)
    seconds, rows = time.perf_counter() - since, trainer.state.num_rows
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else 0
    with torch.no_grad():
        camera = scene.train[0].camera.to(device)
        seen = rasterizer.render(trainer.state.model.gaussians(camera, rasterizer), camera, RasterOptions()).radii > 0
    share = float(seen.float().mean())
    return {"begin": n, "gaussians": rows, "per_second": TIMED / seconds, "peak_bytes": peak, "visible": share}


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _no_other(name: str) -> Any:
    raise AssertionError(f"3dgs starts from no {name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="100000,250000,500000,1000000,2000000,5000000", help="Gaussians, comma list")
    parser.add_argument("--picture", default="799x532", metavar="WIDTHxHEIGHT")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, metavar="FILE", help="append a line of JSON for each size")
    args = parser.parse_args()
    width, height = map(int, args.picture.split("x"))
    scene = scene_of(width, height)
    keep_pictures(scene.train, args.device)
    print(
        f"{'begins with':>12} {'Gaussians':>12} {'steps/s':>8} {'ms':>7} {'MiB':>8} {'bytes each':>10} {'visible':>8}"
    )
    for n in sorted(map(int, args.sizes.split(","))):
        gc.collect()
        if args.device == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        try:
            found = measure(n, scene, args.device)
        except torch.OutOfMemoryError as error:
            print(f"{n:12,} do not fit: {str(error).splitlines()[0][:150]}")
            break
        each = found["peak_bytes"] / found["gaussians"]
        print(
            f"{n:12,} {found['gaussians']:12,} {found['per_second']:8.1f} {1e3 / found['per_second']:7.2f} "
            f"{found['peak_bytes'] / 2**20:8,.0f} {each:10,.0f} {100 * found['visible']:7.1f}%",
            flush=True,
        )
        if args.out is not None:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
