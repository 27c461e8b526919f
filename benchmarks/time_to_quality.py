"""Quality against seconds: presets of 3DGS beside each other, what each part of `fast` brings, and gsplat's trainer.

    python benchmarks/time_to_quality.py DATA/room DATA/fox DATA/lego --seeds 0,1,2 --out out/quality.jsonl
    python benchmarks/time_to_quality.py DATA/fox:images_2 --parts --iterations 3000 --device cpu --out out/parts.jsonl

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo. Seconds are those of the training
loop: statistics, sorting, resizing and spectra count, reading pictures, evaluation and checkpoints do not. `CPU s` are
those of all threads, with reading pictures and without evaluation: on a CPU that is shared they tell more. PSNR and
SSIM are means over the held-out views, peak MiB that of torch's allocator on a GPU, else of the process. Several seeds
are given as mean and half the spread.

--parts     also the last of the presets with each of its parts left out
--also      a further variant, NAME=PRESET,KEY=VALUE,KEY=VALUE
--curve N   also evaluates every N steps, and tells after how many seconds a run is within 0.05 dB of `paper`'s end
--gsplat    also the trainer of benchmarks/train_gsplat.py, at the length of `paper`, where gsplat can be imported
--jobs N    N trainings at once: then only quality counts, and no seconds are printed
--out FILE  a line of JSON a training; what stands there is not trained again
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from scene_names import FORMS, split_scene
from train_cuda import theirs

from splatwizard_core.evaluation.evaluate import evaluate
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.pretrained import make_method
from splatwizard_core.runs.session import Session
from splatwizard_core.streams import stream
from splatwizard_core.training.pipeline import TrainingRun

MIB = 1 << 20
CLOSE = 0.05  # dB below the end of `paper`
PARTS: Mapping[str, Mapping[str, Any]] = {
    "budget": {"density": "adc"},
    "bound by evidence": {"density.settings.growth": 0.0},
    "halving": {"density.settings.opacity": "reset", "density.settings.reset_interval": 3000},
    "morton": {"density.settings.morton": False},
    "resolution": {"pictures.schedule": "none"},
    "average": {"fast.average": 0.0},
    "learning rates": {
        "fast.rates": "given", "lr.position_init": 1.6e-4, "lr.sh_dc": 2.5e-3, "lr.sh_rest": 1.25e-4,
        "lr.opacity": 0.05, "lr.scales": 5e-3, "lr.quats": 1e-3,
    },
    "cap": {"density.settings.cap": 1_000_000},
}  # fmt: skip
"""Part of a fast preset -> what leaves it out; a preset whose first key has that value is without the part anyway."""


@dataclass(frozen=True)
class Variant:
    """One way to train: a preset and what differs from it."""

    name: str
    preset: str
    sets: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Job:
    """One training. `iterations` scales the whole plan; None: as the preset has it."""

    scene: str
    variant: Variant
    seed: int
    device: str
    threads: int
    iterations: int | None
    curve: int

    @property
    def key(self) -> dict[str, Any]:
        """Identity of its line in the file of results."""
        return json.loads(json.dumps(asdict(self)))  # type: ignore[no-any-return]


def trained(job: Job) -> dict[str, Any]:
    """Train and evaluate; the figures."""
    plugins = load_plugins()
    folder, pictures = split_scene(job.scene, plugins)
    sets: dict[str, Any] = {**job.variant.sets, "seed": job.seed, "device": job.device, "threads": job.threads}
    if pictures:
        sets["images"] = pictures
    if job.iterations is not None:
        sets |= {"iterations": job.iterations, "scale_schedule": True}
    if job.curve:
        sets["eval_every"] = job.curve
    resolved = resolve(plugins.methods.load("3dgs"), job.variant.preset, sets=sets, scene=folder, plugins=plugins)
    device = torch.device(job.device)
    if device.type == "cpu" and job.threads:
        torch.set_num_threads(job.threads)
    session = Session(plugins, device, lambda line: print(line, file=sys.stderr))
    scene, method = session.scene(resolved), make_method(plugins, resolved)
    rasterizer = NegotiatedRasterizer(plugins, device=device)
    stages, ppl = list(method.stages()), resolved.ppl
    options = replace(
        stages[-1].raster_options(stages[-1].iterations, scene.background.to(device)),
        grad2d=False, absgrad=False, fragment_grad=False,
    )  # fmt: skip

    aside = 0.0  # CPU seconds of evaluation

    def measure(model: Any, _: int = 0) -> dict[str, float]:
        nonlocal aside
        begin = time.process_time()
        found = evaluate(
            model, scene.test, rasterizer, plugins, device=device, options=options, metrics=["psnr", "ssim"]
        )  # fmt: skip
        aside += time.process_time() - begin
        return {name: metric.mean for name, metric in found.metrics.items() if metric.mean is not None}

    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder_of_log:
        log = Path(folder_of_log, "log.jsonl")
        outcome = TrainingRun(
            stages,
            lambda: method.create_model(scene, stream(ppl.seed, "init")).to(device),
            scene, ppl, rasterizer,
            directory=None, identity={"method": "3dgs"}, trained=_no_other, evaluate=measure, log_path=log,
        ).train()  # fmt: skip
        lines = [json.loads(line) for line in log.read_text("utf-8").splitlines()]
    return {
        "steps": outcome.figures.steps,
        "seconds": outcome.figures.train_s,
        "cpu_seconds": time.process_time() - began - aside,
        **measure(outcome.model),
        "gaussians": outcome.model.num_rows,
        "peak_mib": (outcome.figures.peak_bytes or 0) / MIB,
        "growth": [line["num_gaussians"] for line in lines if "num_gaussians" in line][
            :: max(1, outcome.figures.steps // 200)
        ],
        "curve": [[line["step"], line["train_s"], line["metrics"]["psnr"]] for line in lines if "metrics" in line],
    }


def trained_by_gsplat(job: Job) -> dict[str, Any] | None:
    """Figures of gsplat's trainer, or None with the reason on stderr."""
    folder, pictures = split_scene(job.scene, load_plugins())
    args = argparse.Namespace(seed=job.seed, iterations=job.iterations or 30_000, surfels=None, distortion=0.0)
    found = theirs(folder, pictures or None, args)
    if isinstance(found, str):
        print(f"gsplat: not measured, {found}", file=sys.stderr)
        return None
    seconds = args.iterations / found.iterations_per_second
    return {
        "steps": args.iterations, "seconds": seconds, "psnr": found.psnr, "gaussians": found.gaussians,
        "peak_mib": found.peak_mib,
    }  # fmt: skip


def _no_other(name: str) -> Any:
    raise AssertionError(f"3dgs starts from no {name}")


def variants_of(args: argparse.Namespace, parser: argparse.ArgumentParser) -> list[Variant]:
    """The variants that the command line asks for, `paper` first where it is among them; exits for wrong input."""
    if args.gsplat and args.jobs > 1:
        parser.error("--gsplat is measured alone: leave out --jobs")
    if args.gsplat and args.device == "cpu":
        parser.error("--gsplat is measured on a GPU: leave out --device cpu")
    found = [Variant(preset, preset) for preset in args.presets.split(",") if preset]
    if args.parts:
        if not found:
            parser.error("--parts is about the last of --presets: name one")
        preset = found[-1].preset
        base = resolve(load_plugins().methods.load("3dgs"), preset).config.model_dump()
        for name, sets in PARTS.items():
            key, value = next(iter(sets.items()))
            if _at(base, key) != value:
                found.append(Variant(f"{preset} without {name}", preset, sets))
    for text in args.also:
        name, _, rest = text.partition("=")
        preset, *pairs = rest.split(",")
        if not name or not preset:
            parser.error(f"--also '{text}': it must be NAME=PRESET,KEY=VALUE,...")
        if wrong := [pair for pair in pairs if "=" not in pair]:
            parser.error(f"--also '{text}': '{wrong[0]}' must be KEY=VALUE")
        found.append(Variant(name, preset, dict(pair.split("=", 1) for pair in pairs)))
    if args.gsplat:
        found.append(Variant("gsplat", ""))
    return found


def _at(values: Any, key: str) -> Any:
    for part in key.split("."):
        values = values[part]
    return values


def run(jobs: Sequence[Job], out: Path | None, at_once: int) -> list[dict[str, Any]]:
    """Return a result for each job, those of the file included, in the order of the jobs."""
    known = (
        [] if out is None or not out.exists() else [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    )
    results = {json.dumps(line["job"], sort_keys=True): line for line in known}

    def keep(job: Job, figures: dict[str, Any] | None) -> None:
        if figures is None:
            return
        line = {"job": job.key, **figures, "alone": at_once == 1}
        results[json.dumps(job.key, sort_keys=True)] = line
        print(_row(line), flush=True)
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")

    missing = [job for job in jobs if json.dumps(job.key, sort_keys=True) not in results]
    if at_once == 1 and all(job.device != "cpu" for job in missing):
        for job in missing:
            keep(job, trained(job) if job.variant.preset else trained_by_gsplat(job))
    else:
        with ThreadPoolExecutor(at_once) as pool:
            pending = {pool.submit(_in_fresh_process, job): job for job in missing}
            for done in as_completed(pending):
                keep(pending[done], done.result())
    return [results[key] for key in (json.dumps(job.key, sort_keys=True) for job in jobs) if key in results]


def _in_fresh_process(job: Job) -> dict[str, Any]:
    """Train where nothing was trained before: the memory that a training frees stays with its process, uncounted."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(trained, job).result()


def _row(line: Mapping[str, Any]) -> str:
    job = line["job"]
    seconds = f"{line['seconds']:8.1f} s" if line["alone"] else "         -"
    quality = f"{line['psnr']:6.2f} dB {line.get('ssim', float('nan')):.4f}"
    return (
        f"{Path(job['scene']).name:16} {job['variant']['name']:28} seed {job['seed']} {line['steps']:6,} steps "
        f"{seconds} {quality} {line['gaussians']:9,} {line['peak_mib']:6.0f} MiB"
    )


def summary(lines: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Lines of the table: each variant of each scene over its seeds, beside `paper`."""
    for scene in dict.fromkeys(line["job"]["scene"] for line in lines):
        here = [line for line in lines if line["job"]["scene"] == scene]
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for line in here:
            groups.setdefault(line["job"]["variant"]["name"], []).append(line)
        yield f"\n{scene}"
        yield (
            f"  {'':28} {'steps':>7} {'seconds':>15} {'CPU s':>7} {'of paper':>8} {'PSNR dB':>14} {'to paper':>8} "
            f"{'SSIM':>7} {'Gaussians':>10} {'MiB':>7} {'close after':>11}"
        )
        paper = groups.get("paper")
        for name, group in groups.items():
            yield _summary_row(name, group, paper)


def _summary_row(name: str, group: Sequence[Mapping[str, Any]], paper: Sequence[Mapping[str, Any]] | None) -> str:
    alone = all(line["alone"] for line in group)
    seconds, psnr = _mean(group, "seconds"), _mean(group, "psnr")
    share = difference = close = "-"
    if paper is not None:
        difference = f"{psnr - _mean(paper, 'psnr'):+.2f}"
        if alone and all(line["alone"] for line in paper):
            share = f"{seconds / _mean(paper, 'seconds'):.2f}"
        close = _close_after(group, _mean(paper, "psnr") - CLOSE)
    told = f"{seconds:.1f} ± {_spread(group, 'seconds'):.1f}" if alone else "-"
    ssim = f"{_mean(group, 'ssim'):.4f}" if all("ssim" in line for line in group) else "-"
    quality = f"{psnr:.2f} ± {_spread(group, 'psnr'):.2f}"
    busy = f"{_mean(group, 'cpu_seconds'):.0f}" if all("cpu_seconds" in line for line in group) else "-"
    return (
        f"  {name:28} {group[0]['steps']:7,} {told:>15} {busy:>7} {share:>8} {quality:>14} "
        f"{difference:>8} {ssim:>7} {_mean(group, 'gaussians'):10,.0f} {_mean(group, 'peak_mib'):7,.0f} {close:>11}"
    )


def _mean(group: Sequence[Mapping[str, Any]], key: str) -> float:
    return statistics.fmean(line[key] for line in group)


def _spread(group: Sequence[Mapping[str, Any]], key: str) -> float:
    values = [line[key] for line in group]
    return (max(values) - min(values)) / 2


def _close_after(group: Sequence[Mapping[str, Any]], wanted: float) -> str:
    """Mean seconds after which the curves reach so many dB; "-" if there is none, or one does not."""
    found = [next((s for _, s, psnr in line.get("curve", ()) if psnr >= wanted), None) for line in group]
    reached = [seconds for seconds in found if seconds is not None]
    return f"{statistics.fmean(reached):.1f} s" if len(reached) == len(group) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=FORMS)
    parser.add_argument("--presets", default="paper,fast", help="comma list (default: paper,fast)")
    parser.add_argument("--parts", action="store_true", help="also the last preset without each of its parts")
    parser.add_argument(
        "--also", action="append", default=[], metavar="NAME=PRESET,KEY=VALUE", help="a further variant"
    )
    parser.add_argument("--gsplat", action="store_true", help="also gsplat's trainer")
    parser.add_argument("--seeds", default="0", help="comma list (default: 0)")
    parser.add_argument("--iterations", type=int, help="scale every plan to this length (default: as presets have it)")
    parser.add_argument("--curve", type=int, default=0, metavar="N", help="evaluate every N steps")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=0, help="of a training on the CPU (default: all cores)")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once, for quality alone (default: 1)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="lines of JSON, which a second call goes on from")
    args = parser.parse_args()
    variants = variants_of(args, parser)
    jobs = [
        Job(scene, variant, int(seed), args.device, args.threads, args.iterations, args.curve)
        for scene in args.scenes
        for seed in args.seeds.split(",")
        for variant in variants
    ]
    print("\n".join(summary(run(jobs, args.out, args.jobs))))


if __name__ == "__main__":
    main()
