"""Held-out PSNR and bytes after each stage of a compressing method, of one finished run.

    sw run --method compact3dgs --scene nerf_synthetic:DIR/chair --rate r5 --out out
    python benchmarks/stage_losses.py out/chair/compact3dgs/r5
    python benchmarks/stage_losses.py out/chair/lightgaussian/r3 --every 4 --set codec.settings.ratio=0.8

The run must be trained (`sw train` suffices); nothing is trained here, and nothing is written but FILE of --json. All
rows are of one training, so differences between them are those of a stage alone. --set changes keys of the file.

compact3dgs     the trained model with its shapes as they are, with the sums of codebook entries, the file without
                post-processing, then the steps of post-processing one after the other, and below that the file for
                other thresholds and steps of the grid
lightgaussian   the 3DGS scene, pruned, recovered, without the highest SH bands, distilled, in float16, the file; below
                that what other shares of the codebook cost

"loss" is against the row before, "all" against the first row. Bytes of models are those of their numbers in float32.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from sw_compact3dgs import file as compact_file
from sw_compact3dgs.config import FileSettings
from sw_compact3dgs.decoded import DecodedGaussians
from sw_compact3dgs.model import PLAIN, CompactGaussians
from sw_gaussians.finetune.pruning import lowest, removal_count, up_to

from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel, SplatModel, UserInputError
from splatwizard_core.evaluation.evaluate import evaluate, render_options, suggested_rasterizers
from splatwizard_core.runs.config import ResolvedConfig, parse_set, read_config_file, resolve
from splatwizard_core.runs.directory import CHECKPOINTS, CONFIG, RunRequest
from splatwizard_core.runs.encode import finished_training
from splatwizard_core.runs.session import TrainedModel
from splatwizard_core.runs.training import finished_directory, trained_scene
from splatwizard_core.tooling import Session, choose_device, load_plugins, make_method
from splatwizard_core.training.checkpoint import CheckpointStore
from sw_codecs.context.hash_grid import HashGrid
from sw_lightgaussian.config import LightGaussianConfig
from sw_lightgaussian.stages import truncated

THRESHOLDS = (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15)
STEPS = (0.04, 0.06, 0.08, 0.1, 0.12, 0.16, 0.2)
RATIOS = (0.0, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True)
class Row:
    """A stage: what the model is after it. `aside`: a variant, compared with the first row of its table alone."""

    stage: str
    psnr: float
    bytes: int
    gaussians: int
    aside: bool = False


class Run:
    """A finished run, its scene, and what draws it as its file would be drawn."""

    def __init__(self, directory: Path, sets: list[str], device: str, every: int) -> None:
        self.plugins, self.directory = load_plugins(), directory
        self.resolved = _resolved(directory, sets, self.plugins)
        self.session = Session(self.plugins, choose_device(device, self.plugins), _tell)
        self.scene = self.session.scene(self.resolved)
        self.views = self.scene.test[::every]
        self.method = make_method(self.plugins, self.resolved)
        self.out = directory.resolve().parents[2]
        with finished_training(self.session, self.resolved, directory) as trained:
            self.trained: TrainedModel = trained
        raster = trained.facts.raster
        self.rasterizer = self.session.rasterizer(self.resolved, suggested_rasterizers(raster))
        self.options = render_options(raster, self.scene.background.to(self.session.device))

    @property
    def model(self) -> SplatModel:
        return self.trained.model.eval().requires_grad_(False)

    @torch.no_grad()
    def psnr(self, model: SplatModel) -> float:
        """Mean over the held-out views, as `sw eval` computes it."""
        model = model.to(self.session.device).eval().requires_grad_(False)
        model.prepare()
        found = evaluate(
            model, self.views, self.rasterizer, self.plugins, device=self.session.device, options=self.options,
            quantize8=self.scene.protocol.quantize8, metrics=["psnr"],
        ).metrics["psnr"]  # fmt: skip
        return float("nan") if found.mean is None else found.mean

    def row(self, stage: str, model: SplatModel, size: int | None = None, *, aside: bool = False) -> Row:
        """A row of a model; `size` is that of its file, None: its numbers in float32."""
        if size is None:
            size = 4 * sum(parameter.numel() for parameter in model.parameters())
        return Row(stage, self.psnr(model), size, model.num_rows, aside)

    def trained_in(self) -> Path:
        """The directory whose checkpoints hold the training, which may be another rate point's."""
        found = finished_directory(self.session, RunRequest(self.resolved, self.out), self.directory)
        assert found is not None  # it was just loaded from there
        return found


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _resolved(directory: Path, sets: list[str], plugins: Any) -> ResolvedConfig:
    config = directory / CONFIG
    if not config.exists():
        raise UserInputError(f"{directory} is no run directory, it has no {CONFIG}: give OUT/<scene>/<method>/<rate>")
    method = plugins.methods.load(read_config_file(config)["method"])
    return resolve(method, config_file=config, sets=parse_set(sets), plugins=plugins)


def compact3dgs(run: Run) -> Iterator[Row]:
    """Rows of Compact3DGS: codebooks, float16, 8 bits, zeros, entropy codes, each on top of the ones before."""
    model = run.model
    assert isinstance(model, CompactGaussians)
    settings: FileSettings = run.method.config.codec.settings

    def written(**changed: Any) -> tuple[DecodedGaussians, dict[str, int], int]:
        """The decoded model of a file, the bytes of its sections and of all of it."""
        writer = ContainerWriter(run.method.name, run.method.version)
        compact_file.encode(model, writer, run.plugins, settings.model_copy(update=changed))
        data = writer.to_bytes()
        return compact_file.decode(ContainerReader(data), run.plugins), writer.sections, len(data)

    shapes = copy.deepcopy(model)
    shapes.phase = PLAIN
    numbers = 4 * (11 * model.num_rows + sum(each.numel() for each in model.color.parameters()))
    yield run.row("trained, shapes without codebooks", shapes, numbers)
    yield run.row("shapes as sums of codebook entries", model, numbers)
    built, plain, size = written(pp=False)
    yield run.row("file without post-processing", built, size)
    exact, coarse, _ = written(pp=True, grid_factor=0.0)
    final, sections, whole = written(pp=True)
    built.opacities = exact.opacities
    size += sections["opacities"] - plain["opacities"]
    yield run.row("8 bits for opacities", built, size)
    built.color = exact.color
    size += coarse["grid"] - plain["grid"]
    yield run.row("8 bits for the grid, no zeros, its range / 255", built, size)
    built.color = final.color
    size += sections["grid"] - coarse["grid"]
    zeros, step = (each * settings.grid_factor for each in (settings.grid_threshold, settings.grid_step))
    yield run.row(f"grid: zeros up to {zeros:g}, steps from {step:g}", built, size)
    yield run.row("coded positions and indices: the file", final, whole)
    for threshold in THRESHOLDS:
        found, _, size = written(pp=True, grid_threshold=threshold, grid_step=0.0, grid_factor=1.0)
        yield run.row(f"the file, zeros up to {threshold:g}", found, size, aside=True)
    for step in STEPS:
        found, _, size = written(pp=True, grid_threshold=0.0, grid_step=step, grid_factor=1.0)
        yield run.row(f"the file, steps from {step:g}", found, size, aside=True)
    print_grid(model.color.grid)


def print_grid(grid: HashGrid) -> None:
    """Sizes of the trained values, level by level: which share of them each threshold takes."""
    table = grid.table.detach().cpu()
    shortest = float(table.max().clamp_min(0) - table.min().clamp_max(0)) / 255
    print(f"grid: largest {float(table.abs().max()):.4g}, its range / 255 is {shortest:.4g}")
    print(f"{'level':>5} {'vertices':>8} {'entries':>8} {'rms':>8}" + "".join(f"  <={t:<5g}" for t in THRESHOLDS))
    start = 0
    for number, level in enumerate(grid.levels):
        part = table[start : start + level.size]
        start += level.size
        shares = "".join(f" {float((part.abs() <= t).float().mean()):7.3f}" for t in THRESHOLDS)
        print(f"{number:5} {level.resolution:8} {level.size:8,} {float(part.square().mean().sqrt()):8.4f}{shares}")


def lightgaussian(run: Run) -> Iterator[Row]:
    """Rows of LightGaussian: its stages from their checkpoints, then its file with and without a codebook."""
    config: LightGaussianConfig = run.method.config
    base = trained_scene(run.session, "3dgs", run.resolved, run.out).model
    assert isinstance(base, GaussianModel)
    yield run.row("3DGS, the teacher", base)
    prune = config.prune
    scores = prune.load(run.plugins).score(
        base, [view.camera for view in run.scene.train], run.rasterizer, run.scene.background.to(base.device)
    )
    official = prune.count_rule == "official"
    gone = up_to(scores, prune.percent) if official else lowest(scores, removal_count(len(scores), prune.percent))
    yield run.row(f"without the lowest {prune.percent:.0%}", _gaussians({k: getattr(base, k)[~gone] for k in base.RAW}))
    stages = CheckpointStore(run.trained_in() / CHECKPOINTS)
    recovered = _gaussians(stages.last_of(0).state["model"])
    yield run.row(f"trained on for {run.method.stages()[0].iterations:,} steps", recovered)
    degree = config.distill.sh_degree
    yield run.row(f"without SH bands above {degree}", truncated(recovered.to(run.session.device), degree))
    distilled = run.model
    assert isinstance(distilled, GaussianModel)
    yield run.row(f"distilled for {run.method.stages()[1].iterations:,} steps", distilled)

    def written(ratio: float | None = None) -> tuple[SplatModel, int]:
        sets = {} if ratio is None else {"ratio": ratio}
        codec = config.codec.model_copy(update={"settings": {**dict(config.codec.settings), **sets}})
        method = type(run.method)(run.plugins, config.model_copy(update={"codec": codec}))
        writer = ContainerWriter(method.name, method.version)
        method.encode(distilled, writer)
        data = writer.to_bytes()
        return method.decode(ContainerReader(data)), len(data)

    found, size = written(0.0)
    yield run.row("float16 but for positions", found, size)
    found, size = written()
    yield run.row("codebook: the file", found, size)
    for ratio in RATIOS:
        found, size = written(ratio)
        yield run.row(f"the file, a codebook for {ratio:.0%}", found, size, aside=True)


def _gaussians(tensors: dict[str, Any]) -> GaussianModel:
    names = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
    return GaussianModel.from_tensors(*(tensors[name].detach() for name in names), active_sh_degree=3)


METHODS: dict[str, Callable[[Run], Iterator[Row]]] = {"compact3dgs": compact3dgs, "lightgaussian": lightgaussian}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run directory of a finished training, OUT/<scene>/<method>/<rate>")
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:N (default: a GPU where there is one)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="measure on every N-th held-out view")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="keys of the file to change")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there too")
    args = parser.parse_args()
    try:
        run = Run(args.run, args.set, args.device, args.every)
        if run.method.name not in METHODS:
            parser.error(f"{args.run} is of {run.method.name}; stages are known of {', '.join(METHODS)}")
        views = f"{len(run.views)} held-out views, {run.session.device}"
        print(f"{args.run}: {run.method.name} on {run.scene.name}, {views}")
        print(f"{'stage':46} {'Gaussians':>10} {'bytes':>12} {'PSNR':>8} {'loss':>7} {'all':>7}")
        rows: list[Row] = []
        for row in METHODS[run.method.name](run):
            first = rows[0] if rows else row
            before = row if not rows else next(r for r in reversed(rows) if not r.aside)
            loss = "" if row.aside else f"{before.psnr - row.psnr:7.3f}"
            told = f"{row.gaussians:10,} {row.bytes:12,} {row.psnr:8.3f} {loss:>7} {first.psnr - row.psnr:7.3f}"
            print(f"{row.stage:46} {told}", flush=True)
            rows.append(row)
    except UserInputError as error:
        print(error, file=sys.stderr)
        return 1
    if args.json is not None:
        args.json.write_text(json.dumps([vars(row) for row in rows], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
