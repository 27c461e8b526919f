"""Training speed of 3DGS on a GPU, beside gsplat's trainer on the same pictures, and where a step's time goes.

    python benchmarks/train_cuda.py ../shared/data/mug ../shared/data/fox:images_2 ../shared/data/lego

    python benchmarks/train_cuda.py DATA/room DATA/fox:images_2 --surfels 1000 --distortion 10 --iterations 5000

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo. Where gsplat cannot be imported, only
ours is measured. Its trainer is train_gsplat.py beside this file, which says what SSIM and which opacity reset it has.

One after the other, so that nothing shares the GPU. Iterations a second count the loop alone, densification included,
as both trainers report it; PSNR is the mean over the held-out views, memory the peak of torch's allocator in the loop.

--surfels STEP trains 2DGS: normal consistency to the expected depth, and distortion where it has a weight, after STEP.

--profile trains ours once more and says, of windows of steps early, half-way and late: wall clock, the time in which
the GPU had work, kernels launched, and what took longest on the device and on the host (torch.profiler slows the host
down, so it watches other steps than the clock).

--records FILE appends a line of JSON a training, of which `python tools/results.py tables` makes the table of
docs/results.md (docs/records/trainers/gsplat.jsonl).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import subprocess
import sys
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
from scene_names import FORMS, split_scene
from torch.profiler import ProfilerActivity, profile

from splatwizard_core.evaluation.evaluate import evaluate
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.device import device_reason
from splatwizard_core.runs.pretrained import make_method
from splatwizard_core.runs.session import Session
from splatwizard_core.streams import stream
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_core.training.state import TrainingState
from splatwizard_native import work_time

WINDOW = 40  # steps that are timed, and as many after them that are profiled
MIB = 1 << 20


@dataclass
class Figures:
    """Figures of one trainer on one scene."""

    iterations_per_second: float
    psnr: float
    gaussians: int
    peak_mib: float
    trainer: str = "splatwizard"
    note: str = ""

    def record(self, scene: str, args: argparse.Namespace) -> str:
        """A line of JSON with the fields of `Training` in tools/trainer_records.py."""
        values = {
            "trainer": self.trainer, "scene": scene, "plan": plan_of(args), "steps": args.iterations, "seed": args.seed,
            "psnr": self.psnr, "gaussians": self.gaussians, "per_second": self.iterations_per_second,
            "peak_mib": self.peak_mib, "device": torch.cuda.get_device_name(),
            "date": datetime.now(timezone.utc).date().isoformat(), "note": self.note,
        }  # fmt: skip
        return json.dumps(values) + "\n"


@dataclass
class Watch:
    """Called after each step: times and profiles two windows of steps that follow each of `starts`."""

    starts: tuple[int, ...]
    lines: list[str] = field(default_factory=list)
    _since: float = 0.0
    _wall: float = 0.0
    _profile: profile | None = None

    def __call__(self, record: TrainingState) -> None:
        for start in self.starts:
            if record.step == start:
                torch.cuda.synchronize()
                self._since = work_time()
            elif record.step == start + WINDOW:
                torch.cuda.synchronize()
                self._wall = (work_time() - self._since) / WINDOW
                self._profile = profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA])
                self._profile.__enter__()
            elif record.step == start + 2 * WINDOW and self._profile is not None:
                torch.cuda.synchronize()
                self._profile.__exit__(None, None, None)
                self._report(record)

    def _report(self, record: TrainingState) -> None:
        assert self._profile is not None
        found = self._profile.key_averages()
        on_device = [e for e in found if str(e.device_type).endswith("CUDA")]
        busy = sum(e.self_device_time_total for e in on_device) / WINDOW
        launches = sum(e.count for e in on_device) / WINDOW
        self.lines.append(
            f"  steps {record.step - 2 * WINDOW + 1:,} to {record.step:,}, {record.num_rows:,} Gaussians: "
            f"{1e3 * self._wall:.2f} ms per step, GPU at work {busy / 1e3:.2f} ms in {launches:.0f} launches"
        )
        for e in sorted(on_device, key=lambda e: -e.self_device_time_total)[:6]:
            self.lines.append(f"    device {e.self_device_time_total / WINDOW:7.1f} us  {_short(e.key)}")
        on_host = [e for e in found if not str(e.device_type).endswith("CUDA")]
        for e in sorted(on_host, key=lambda e: -e.self_cpu_time_total)[:6]:
            self.lines.append(
                f"    host   {e.self_cpu_time_total / WINDOW:7.1f} us  {_short(e.key)} x{e.count / WINDOW:.0f}"
            )
        self._profile = None


def _short(name: str) -> str:
    return name.replace("(anonymous namespace)::", "").replace("void ", "", 1)[:70]


def plan_of(args: argparse.Namespace) -> str:
    """The method that both train."""
    return "3dgs" if args.surfels is None else "2dgs"


def ours(folder: str, pictures: str | None, args: argparse.Namespace, watch: Watch | None) -> Figures:
    """Figures of this trainer."""
    plugins = load_plugins()
    # As gsplat's trainer has them: steps by number, whatever the length of the plan.
    sets: dict[str, Any] = {"iterations": args.iterations, "seed": args.seed, "device": "cuda"}
    if pictures is not None:
        sets["images"] = pictures
    if args.surfels is not None:
        after = {"surface.dist_after": args.surfels, "surface.normal_after": args.surfels, "surface.depth_ratio": 0.0}
        sets |= {**after, "surface.lambda_dist": args.distortion, "surface.lambda_normal": 0.05}
    resolved = resolve(plugins.methods.load(plan_of(args)), "paper", sets=sets, scene=folder)
    session = Session(plugins, torch.device("cuda"), lambda line: print(line, file=sys.stderr))
    scene = session.scene(resolved)
    method = make_method(plugins, resolved)
    rasterizer = NegotiatedRasterizer(plugins, device=session.device)
    ppl = resolved.ppl
    stages = list(method.stages())
    outcome = TrainingRun(
        stages,
        lambda: method.create_model(scene, stream(ppl.seed, "init")).to(session.device),
        scene,
        ppl,
        rasterizer,
        directory=None,
        identity={"method": plan_of(args)},
        trained=_no_other,
        on_step=None if watch is None else lambda _, record: watch(record),
    ).train()
    options = stages[-1].raster_options(args.iterations, scene.background.cuda())
    options = replace(
        options, grad2d=False, absgrad=False, normals=False, distortion=False, alpha=False, depth=frozenset()
    )
    result = evaluate(
        outcome.model, scene.test, rasterizer, plugins, device=session.device, options=options, metrics=["psnr"]
    )
    psnr = result.metrics["psnr"].mean
    assert psnr is not None
    return Figures(
        outcome.figures.steps / outcome.figures.train_s,
        psnr,
        outcome.model.num_rows,
        (outcome.figures.peak_bytes or 0) / MIB,
    )


def _no_other(name: str) -> Any:
    raise AssertionError(f"3dgs starts from no {name}")


def theirs(folder: str, pictures: str | None, args: argparse.Namespace) -> Figures | str:
    """Figures of gsplat's trainer in a process of its own, or why there are none."""
    if importlib.util.find_spec("gsplat") is None:
        return "it cannot be imported"
    command = [sys.executable, str(Path(__file__).with_name("train_gsplat.py")), folder, "--seed", str(args.seed)]
    if args.surfels is not None:
        command += ["--surfels", str(args.surfels), "--distortion", str(args.distortion)]
    command += ["--iterations", str(args.iterations), *(["--images", pictures] if pictures else [])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if done.returncode != 0 or not lines:
        return f"it failed: {(done.stderr.strip().splitlines() or ['no output'])[-1][:200]}"
    found = json.loads(lines[-1].removeprefix("RESULT "))
    note = f"SSIM of {found['ssim_impl']}, opacities reset by {found['reset']}"
    speed = found["iters"] / found["train_s"]
    return Figures(speed, found["psnr"], found["n"], found["peak_mib"], f"gsplat {found['gsplat']}", note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=FORMS)
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--surfels", type=int, metavar="STEP", help="2DGS, losses of the surface after STEP")
    parser.add_argument("--distortion", type=float, default=0.0, help="weight of its distortion (default: 0, no loss)")
    parser.add_argument("--records", type=Path, metavar="FILE", help="append a line of JSON a training")
    parser.add_argument("--profile", action="store_true", help="also where a step's time goes")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("torch sees no CUDA device here")
    plugins = load_plugins()
    print(device_reason("cuda", torch.device("cuda"), plugins))
    ratios = []
    for asked in args.scenes:
        scene, pictures = split_scene(asked, plugins)
        mine = ours(scene, pictures or None, args, None)
        family, colon, folder = scene.rpartition(":")
        name = f"{family}{colon}{Path(folder).name} {pictures}".strip()  # read as another family, it is another scene
        print(f"{name:16} {'it/s':>7} {'PSNR':>7} {'Gaussians':>10} {'peak MiB':>9}")
        print(_row("ours", mine))
        other = theirs(scene, pictures or None, args)
        if isinstance(other, str):
            print(f"  gsplat: not measured, {other}")
        else:
            print(_row(other.trainer, other))
            ratio = mine.iterations_per_second / other.iterations_per_second
            ratios.append(ratio)
            memory = mine.peak_mib / other.peak_mib
            print(
                f"  ours / gsplat: {ratio:.2f} x its/s, {mine.psnr - other.psnr:+.2f} dB, {memory:.2f} x memory",
                flush=True,
            )
        if args.records is not None:
            with args.records.open("a", encoding="utf-8") as file:
                file.writelines(f.record(name, args) for f in (mine, other) if not isinstance(f, str))
        if args.profile:
            last = args.iterations - 2 * WINDOW - 10
            watch = Watch(tuple(step for step in (1010, args.iterations // 2 + 10, last) if step > 0))
            ours(scene, pictures or None, args, watch)
            print("\n".join(watch.lines), flush=True)
    if ratios:
        print(f"iterations/s over gsplat's, geometric mean of {len(ratios)}: {statistics.geometric_mean(ratios):.2f}")


def _row(name: str, f: Figures) -> str:
    figures = f"{f.iterations_per_second:7.1f} {f.psnr:7.2f} {f.gaussians:10,} {f.peak_mib:9.0f}"
    return f"  {name:14} {figures}  {f.note}".rstrip()


if __name__ == "__main__":
    main()
