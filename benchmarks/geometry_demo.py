"""Pictures against surfaces: PSNR and Chamfer distance of methods on the demo scene, and of their small files.

    python benchmarks/geometry_demo.py out/geometry                                 # trains, meshes, prints the tables
    python benchmarks/geometry_demo.py out/geometry --train-only --device cuda --jobs 6   # where Open3D is not
    python benchmarks/geometry_demo.py out/geometry --mesh-only                           # where it is

Training: `sw run` of each method, rate point and seed, below --runs; what is finished is not done again. Then
OUT/seed-N.zip takes what the mesh needs of that seed: files and facts. Of a float32 file it takes the colours of SH
degree 0 alone, a quarter of the bytes, since neither depth nor the colour of a mesh depends on the others.

Meshing: `sw mesh --chamfer` of each file in OUT/seed-*.zip; figures are kept in OUT/geometry.json, and what is in there
is not done again. The tables are means over the seeds, with the standard deviation between them.

--methods is a comma list of METHOD@RATE+RATE...; the last rate point of a method is what its others are compared with.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import zipfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from splatwizard_core.base.files import file_sha256
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.pretrained import named_scenes
from splatwizard_native import available_cores

METHODS = "3dgs@r3+r4+r6,2dgs@r3+r4+r6,trim-3dgs@r3+r4+r6,trim-2dgs@r3+r4+r6,hac@r3"
LONGEST = 200  # characters of an error
EXACT = "gaussians-exact"  # codec of float32 files
MODEL, FACTS = "scene.swz", "facts.json"


class CommandError(Exception):
    """Message of `sw`, in one line."""


def sw(*arguments: object, threads: int) -> dict[str, Any]:
    """JSON that a command prints, from a fresh process of so many threads. Raises CommandError."""
    command = [sys.executable, "-m", "splatwizard_core", *map(str, arguments), "--json"]
    environment = {"OMP_NUM_THREADS": str(threads), **os.environ}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()
        said = next((line for line in reversed(lines) if line.startswith("error: ")), lines[-1])
        raise CommandError(f"sw {arguments[0]}: {' '.join(said.removeprefix('error: ').split())[:LONGEST]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@dataclass(frozen=True)
class Job:
    """Rate points of one method and seed."""

    method: str
    rates: tuple[str, ...]
    seed: int

    def folders(self, runs: Path, scene: str) -> dict[str, Path]:
        """Rate point -> its run directory."""
        place = runs / f"seed-{self.seed}" / scene.replace(":", "-") / self.method
        return {rate: place / rate for rate in self.rates}

    def train(self, args: argparse.Namespace) -> str | None:
        """Run what is not finished; returns what went wrong."""
        folders = self.folders(args.runs, args.scene)
        left = [rate for rate, folder in folders.items() if not (folder / "metrics.json").exists()]
        if not left:
            return None
        words = ["--method", self.method, "--rate", ",".join(left), "--scene", args.scene, "--seed", self.seed]
        words += ["--out", args.runs / f"seed-{self.seed}", "--device", args.device]
        words += [word for value in args.set for word in ("--set", value)]
        try:
            sw("run", *words, threads=args.threads)
        except CommandError as error:
            return f"{self.method} of seed {self.seed}: {error}"
        print(f"trained: {self.method}, seed {self.seed}", flush=True)
        return None


def waves(jobs: Sequence[Job], plugins: PluginManager) -> list[list[Job]]:
    """Jobs in two groups: those that start from a scene that another one trains come second."""
    asked = {job.method for job in jobs}

    def waits(job: Job) -> bool:
        cls = plugins.methods.load(job.method)
        return bool(asked & set(named_scenes(cls(plugins, cls.Config()))))

    return [[job for job in jobs if not waits(job)], [job for job in jobs if waits(job)]]


def train_all(jobs: Sequence[Job], args: argparse.Namespace) -> list[str]:
    """Train everything, packing a seed anew after each of its jobs; returns what went wrong."""
    plugins, lock = load_plugins(), threading.Lock()

    def done(job: Job) -> str | None:
        wrong = job.train(args)
        with lock:  # whatever ends this command early, what was trained by then is packed
            pack([each for each in jobs if each.seed == job.seed], args, plugins)
        return wrong

    with ThreadPoolExecutor(args.jobs) as pool:
        found = [each for wave in waves(jobs, plugins) for each in pool.map(done, wave)]
    return [each for each in found if each is not None]


def pack(jobs: Sequence[Job], args: argparse.Namespace, plugins: PluginManager) -> None:
    """Write OUT/seed-N.zip: METHOD/RATE/scene.swz and facts.json of each finished run of a seed."""
    with zipfile.ZipFile(args.out / f"seed-{jobs[0].seed}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for job in jobs:
            for rate, folder in job.folders(args.runs, args.scene).items():
                if not (folder / "metrics.json").exists():
                    continue
                record = json.loads((folder / "metrics.json").read_text("utf-8"))
                facts = {
                    "bytes": (folder / MODEL).stat().st_size,
                    "psnr": record["metrics"]["psnr"]["mean"],
                    "counts": record["counts"],
                    "scene": args.scene,
                }
                archive.writestr(f"{job.method}/{rate}/{FACTS}", json.dumps(facts))
                archive.writestr(f"{job.method}/{rate}/{MODEL}", of_degree_0(folder / MODEL, plugins))


def of_degree_0(file: Path, plugins: PluginManager) -> bytes:
    """A file as it is, or, if its Gaussians are float32, one with SH band 0 alone."""
    import torch

    from splatwizard_core.gaussians.model import GaussianModel
    from splatwizard_core.runs.decode import open_model
    from splatwizard_core.runs.encode import encode

    model, reader = open_model(file, plugins, torch.device("cpu"))
    codec = reader.static.get("codec", reader.static.get("mode"))  # files of 3dgs call it their mode
    if codec not in ("exact", EXACT) or not isinstance(model, GaussianModel):
        return file.read_bytes()
    model.sh_rest.data = model.sh_rest.data[:, :0].contiguous()
    model.active_sh_degree = 0
    cls = plugins.methods.load(reader.method)
    with tempfile.TemporaryDirectory() as folder:
        config = resolve(cls, "paper", sets={"codec.name": EXACT}, plugins=plugins).config
        encode(cls(plugins, config), model, reader.raster, Path(folder) / MODEL)
        return (Path(folder) / MODEL).read_bytes()


def mesh_all(args: argparse.Namespace) -> list[str]:
    """Mesh every packed file that has no figures yet; returns what went wrong."""
    kept, wrong = args.out / "geometry.json", []
    found: dict[str, Any] = json.loads(kept.read_text("utf-8")) if kept.exists() else {}
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as pool:
        due = []
        for archive in sorted(args.out.glob("seed-*.zip")):
            zipfile.ZipFile(archive).extractall(Path(scratch) / archive.stem)
            for file in sorted((Path(scratch) / archive.stem).glob(f"*/*/{MODEL}")):
                name = "/".join((archive.stem, *file.parts[-3:-1]))
                if found.get(name, {}).get("sha256") != file_sha256(file) or found[name]["voxel"] != args.voxel_size:
                    due.append((name, file))
        for (name, _), answer in zip(due, pool.map(lambda pair: measured(pair[1], args), due), strict=True):
            if isinstance(answer, str):
                wrong.append(f"{name}: {answer}")
                continue
            found[name] = answer
            kept.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            print(f"meshed: {name}, chamfer {answer['chamfer']:.5f}", flush=True)
    return wrong


def measured(file: Path, args: argparse.Namespace) -> dict[str, Any] | str:
    """The figures of one file, or what went wrong."""
    facts = json.loads((file.parent / FACTS).read_text("utf-8"))
    words = ["mesh", file, "--scene", facts.pop("scene"), "--chamfer", "--device", "cpu", "--out", file.parent / "mesh"]
    words += ["--voxel-size", args.voxel_size] if args.voxel_size else []
    try:
        answer = sw(*words, threads=args.threads)
    except CommandError as error:
        return str(error)
    scores, sha256 = answer["chamfer"], file_sha256(file)
    return {**facts, "sha256": sha256, "voxel": args.voxel_size, "chamfer": scores["overall"], "f1": scores["f1"],
            "acc": scores["acc"], "comp": scores["comp"]}  # fmt: skip


def spread(values: Sequence[float], digits: str) -> str:
    """Mean ± standard deviation of the seeds; without the latter for one."""
    mean = format(statistics.fmean(values), digits)
    return f"{mean} ± {format(statistics.stdev(values), digits)}" if len(values) > 1 else mean


def tables(found: Mapping[str, Mapping[str, Any]], methods: Mapping[str, Sequence[str]]) -> list[Table]:
    """PSNR against Chamfer distance of each method at its last rate point, and of its files against that one's."""
    first = Table("method", "rate", "seeds", "bytes", "PSNR, dB", "Chamfer", "F1", title="picture and surface")
    second = Table(
        "method", "rate", "seeds", "bytes, %", "Chamfer / whole", "PSNR lost, dB", title="of the last rate point"
    )
    for method, rates in methods.items():
        by_rate = {
            rate: {key.split("/")[0]: facts for key, facts in found.items() if key.split("/")[1:] == [method, rate]}
            for rate in rates
        }
        whole = by_rate[rates[-1]]
        for rate in rates:
            rows = by_rate[rate]
            if not rows:
                continue
            of = partial(lambda key, rows: [facts[key] for facts in rows.values()], rows=rows)
            first.add_row(
                method, rate, str(len(rows)), f"{statistics.fmean(of('bytes')):,.0f}", spread(of("psnr"), ".2f"),
                spread(of("chamfer"), ".5f"), spread(of("f1"), ".3f"),
            )  # fmt: skip
            both = [(rows[seed], whole[seed]) for seed in rows if seed in whole]  # each seed against itself
            if rate == rates[-1] or not both:
                continue
            second.add_row(
                method, rate, str(len(both)), spread([100 * a["bytes"] / b["bytes"] for a, b in both], ".1f"),
                spread([a["chamfer"] / b["chamfer"] for a, b in both], ".3f"),
                spread([b["psnr"] - a["psnr"] for a, b in both], ".2f"),
            )  # fmt: skip
    return [first, second]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where seed-N.zip and geometry.json are kept")
    parser.add_argument("--runs", type=Path, help="where the run directories are (default: OUT/runs)")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--train-only", action="store_true", help="train and pack")
    only.add_argument("--mesh-only", action="store_true", help="mesh what was packed, print the tables")
    parser.add_argument("--methods", default=METHODS, help=f"METHOD@RATE+RATE,... (default: {METHODS})")
    parser.add_argument("--seeds", default="0,1,2", help="comma list (default: 0,1,2)")
    parser.add_argument("--scene", default="demo", help="one with exact geometry (default: demo)")
    parser.add_argument("--device", default="auto", help="of the training: auto, cpu or cuda (default: auto)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every training")
    parser.add_argument("--voxel-size", type=float, default=0.02, help="0: that of `sw mesh` (default: 0.02)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (default: 1)")
    args = parser.parse_args()
    args.runs = args.runs or args.out / "runs"
    args.threads = max(1, available_cores() // args.jobs)
    args.out.mkdir(parents=True, exist_ok=True)
    methods = {name: tuple(rates.split("+")) for name, _, rates in (m.partition("@") for m in args.methods.split(","))}
    wrong = []
    if not args.mesh_only:
        seeds = [int(seed) for seed in args.seeds.split(",")]
        wrong += train_all([Job(name, rates, seed) for seed in seeds for name, rates in methods.items()], args)
    if not args.train_only:
        wrong += mesh_all(args)
        kept = args.out / "geometry.json"
        for table in tables(json.loads(kept.read_text("utf-8")) if kept.exists() else {}, methods):
            Console(width=None if sys.stdout.isatty() else 120).print(table)
    print("\n".join(wrong), file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
