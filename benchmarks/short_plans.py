"""Quality and CPU time of short plans: PSNR and SSIM of the files, bytes and CPU seconds, of a preset and variants.

    python benchmarks/short_plans.py --method 3dgs --seeds 0,1,2 --out out/quick.jsonl
    python benchmarks/short_plans.py --method chimerags --also usual=distill.beta2=0.999,distill.iterations=900

Every variant is trained on one thread, encoded at a rate point, and its file is decoded and drawn on the held-out
views. CPU seconds are those of training, of all threads, without what it starts from; they mean more than the clock on
a machine that others use too. What a method starts from or is taught by is trained once, in its preset of that name.

--also      a further variant, NAME=KEY=VALUE,KEY=VALUE
--out FILE  a line of JSON a training; what stands there is not trained again
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

import splatwizard_core as sw
from splatwizard_core.evaluation.evaluate import evaluate
from splatwizard_core.plugins.manager import PluginManager, load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import ResolvedConfig, resolve
from splatwizard_core.runs.encode import encode
from splatwizard_core.runs.pretrained import base_config, make_method
from splatwizard_core.runs.session import Session
from splatwizard_core.streams import stream
from splatwizard_core.training.pipeline import TrainingRun

COLUMNS = ("psnr", "ssim", "bytes", "rows", "cpu_seconds")
CPU = torch.device("cpu")


class Bench:
    """Trains on one scene, and keeps what trainings start from."""

    def __init__(self, plugins: PluginManager) -> None:
        self.plugins = plugins
        self.starts: dict[str, Any] = {}
        self.rasterizer = NegotiatedRasterizer(plugins, device=CPU)

    def train(self, resolved: ResolvedConfig) -> tuple[Any, Any, Any, float]:
        """Return method, scene, trained model and the CPU seconds of it."""
        scene = Session(self.plugins, CPU, lambda line: None).scene(resolved)
        method = make_method(self.plugins, resolved)
        method.scene = scene
        aside = 0.0

        def start(name: str) -> Any:
            nonlocal aside
            began = time.process_time()
            base = base_config(self.plugins, name, resolved)
            key = f"{name} {base.training_hash()} {base.ppl.seed}"
            if key not in self.starts:
                self.starts[key] = self.train(base)[2].eval().requires_grad_(False)
            aside += time.process_time() - began
            return self.starts[key]

        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            model = (
                TrainingRun(
                    list(method.stages()),
                    lambda: method.create_model(scene, stream(resolved.ppl.seed, "init")),
                    scene, resolved.ppl, self.rasterizer,
                    directory=None, identity={"method": resolved.method}, trained=start,
                    evaluate=lambda model, step: {}, log_path=Path(folder, "log.jsonl"),
                )
                .train()
                .model
            )  # fmt: skip
        return method, scene, model, time.process_time() - began - aside

    def measure(self, resolved: ResolvedConfig) -> dict[str, float]:
        """Return the figures of one training and its file."""
        method, scene, model, seconds = self.train(resolved)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "scene.swz")
            size = encode(method, model, {}, file).bytes
            decoded = sw.decode(file).model
        options = RasterOptions(background=scene.background)
        found = evaluate(
            decoded, scene.test, self.rasterizer, self.plugins, device=CPU, options=options, metrics=["psnr", "ssim"]
        )
        return {
            **{name: metric.mean for name, metric in found.metrics.items() if metric.mean is not None},
            "bytes": size, "rows": model.num_rows, "cpu_seconds": seconds,
        }  # fmt: skip


def table(lines: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Lines of the table: means over the seeds, and the spread of PSNR."""
    yield f"{'':24} {'n':>2} {'PSNR dB':>15} {'SSIM':>7} {'bytes':>9} {'rows':>7} {'CPU s':>6}"
    for name in dict.fromkeys(line["name"] for line in lines):
        group = [line for line in lines if line["name"] == name]
        psnr, ssim, size, rows, seconds = (statistics.fmean(line[column] for line in group) for column in COLUMNS)
        spread = statistics.stdev(line["psnr"] for line in group) if len(group) > 1 else 0.0
        yield (
            f"{name:24} {len(group):2} {psnr:8.2f} ± {spread:4.2f} {ssim:7.4f} {size:9,.0f} {rows:7,.0f} {seconds:6.1f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="3dgs")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--rate", help="rate point (default: the method's)")
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--seeds", default="0,1,2", help="comma list")
    parser.add_argument("--also", action="append", default=[], metavar="NAME=KEY=VALUE", help="a further variant")
    parser.add_argument("--out", type=Path, metavar="FILE", help="lines of JSON, which a second call goes on from")
    args = parser.parse_args()
    torch.set_num_threads(1)
    variants: dict[str, dict[str, str]] = {args.preset: {}}
    for text in args.also:
        name, _, pairs = text.partition("=")
        if not all("=" in pair for pair in pairs.split(",")):
            parser.error(f"--also '{text}': it must be NAME=KEY=VALUE,KEY=VALUE,...")
        variants[name] = dict(pair.split("=", 1) for pair in pairs.split(","))
    plugins = load_plugins()
    bench, cls = Bench(plugins), plugins.methods.load(args.method)
    known = [] if args.out is None or not args.out.exists() else args.out.read_text("utf-8").splitlines()
    lines = [json.loads(line) for line in known]
    for seed in map(int, args.seeds.split(",")):
        for name, sets in variants.items():
            job = {"name": name, "method": args.method, "rate": args.rate, "sets": sets, "seed": seed}
            if any(all(line[key] == value for key, value in job.items()) for line in lines):
                continue
            given = {**sets, "seed": seed, "device": "cpu", "threads": 1}
            rate = args.rate or cls.DEFAULT_RATE
            line = {
                **job,
                **bench.measure(resolve(cls, args.preset, rate, sets=given, scene=args.scene, plugins=plugins)),
            }
            lines.append(line)
            if args.out is not None:
                args.out.parent.mkdir(parents=True, exist_ok=True)
                with args.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            print(next(iter(list(table([line]))[1:])), flush=True)
    print("\n".join(table(lines)))


if __name__ == "__main__":
    main()
