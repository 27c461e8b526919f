"""Small records of runs: what the tables of docs/results.md and README.md need, one line of JSON a run.

A run directory holds metrics.json and, where benchmarks/results_matrix.py made it, matrix.json: the command, how many
runs shared the GPU, and rendering measured once more with nothing else on it. Both are read; neither is kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from splatwizard_core.api import create_method
from splatwizard_core.plugins import PluginManager
from splatwizard_core.tooling import read_record

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "docs" / "records"
MIB = 2**20
FROM = "from "
"""Begins the variant of a run whose start was trained by a preset that was asked for."""


@dataclass(frozen=True)
class SmallRecord:
    """Facts of one run; None: not measured.

    variant             preset, where a method has several plans worth a row ("mcmc"), or "from PRESET" where what it
                        starts from or is taught by was trained by another preset than without being asked; else ""
    rate                rate point of the file
    scene, images       name, and picture size as WxH
    steps               of the method itself, all its stages; without those of a scene that it starts from
    starts_from         what the first stage begins with: "points", a method's trained scene, or the name of a .ply
    taught_by           methods whose trained scenes teach
    gaussians, anchors  in the decoded file
    train_s, start_s    seconds of training, and of the trained scenes that it needs, before it
    alone               nothing else ran on the GPU while it trained
    fps, rasterizer     of the rasterizer that the file asks for, with its kernels: "flash", "speedy (standard)"
    default_fps, default_rasterizer     of the one that draws files without such a wish
    fps_alone           nothing else ran on the GPU while it drew
    render_bytes        peak while rendering, the model included; train_bytes: peak of training
    memory_kind         "cuda" (torch's allocator) or "rss" (growth of the resident set)
    device              GPU or CPU
    version             of the core and of the method's package
    repetition          number of the matrix of runs: a seed that ran twice on a GPU gave two results, and a file is
                        compared with the 3DGS of its own matrix
    """

    method: str
    variant: str
    rate: str
    default_rate: bool
    preset: str
    scene: str
    images: str
    train_views: int
    test_views: int
    seed: int
    steps: int | None
    starts_from: str
    taught_by: list[str]
    psnr: float | None
    ssim: float | None
    lpips: float | None
    bytes: int
    gaussians: int | None
    anchors: int | None
    encode_s: float | None
    decode_s: float | None
    train_s: float | None
    start_s: float | None
    alone: bool
    fps: float
    rasterizer: str
    default_fps: float
    default_rasterizer: str
    fps_alone: bool
    render_bytes: int
    train_bytes: int | None
    memory_kind: str
    device: str
    version: str
    protocol: str
    date: str
    command: str
    repetition: int

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """Identity among the runs of one scene: method, variant, rate point, seed, repetition."""
        return self.method, self.variant, self.rate, self.seed, self.repetition


def extract(run: Path, plugins: PluginManager, repetition: int = 0) -> SmallRecord:
    """Read a run directory. Raises UserInputError for a damaged record, PluginError where its method is missing."""
    record = read_record(run / "metrics.json")
    path = run / "matrix.json"
    beside: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    quiet: Mapping[str, Any] = beside.get("quiet") or {}
    speed = quiet.get("speed") or record.speed.model_dump()
    memory = quiet.get("memory") or record.memory.model_dump()
    served, entries = (
        sorted(set(record.rasterizers.get("render", {}).values())),
        {name: plugins.rasterizers.entry(name) for name in plugins.rasterizers.names},
    )
    noted = speed.get("drawn_by")  # not by older releases
    default: Mapping[str, float] = speed.get("default_fps") or {}
    drawn = _drawn(
        noted or {n: entries[n].declared.get("kernels") or entries[n].name if n in entries else n for n in served}
    )
    stages = create_method(plugins, record.method).stages()
    start = stages[0].starts_from
    train, environment = record.train, record.environment
    files = [p.file["name"] for p in (train.pretraining or {}).values() if p.file]

    def mean(*names: str) -> float | None:
        found = (record.metrics[name].mean for name in names if name in record.metrics)
        return next((value for value in found if value is not None), None)

    cls = plugins.methods.load(record.method)
    with_start = train.with_pretraining_s
    size = record.speed.image_size
    return SmallRecord(
        method=record.method,
        variant=_variant(record.preset, {name: p.preset for name, p in (train.pretraining or {}).items()}, plugins),
        rate=record.rate or "",
        default_rate=record.rate == cls.DEFAULT_RATE,
        preset=record.preset or "",
        scene=record.scene,
        images=f"{size[0]}x{size[1]}",
        train_views=record.train_views,
        test_views=record.test_views,
        seed=int(environment.get("seed") or 0),
        steps=train.steps,
        starts_from=files[0] if files else start or "points",
        taught_by=sorted({name for stage in stages for name in stage.taught_by}),
        psnr=mean("psnr"),
        ssim=mean("ssim"),
        lpips=mean("lpips_vgg_3dgs"),
        bytes=record.file.bytes,
        gaussians=record.counts.get("num_gaussians"),
        anchors=record.counts.get("num_anchors"),
        encode_s=record.codec.encode_s,
        decode_s=record.codec.decode_s,
        train_s=train.train_s,
        start_s=None if with_start is None or train.train_s is None else with_start - train.train_s,
        alone=beside.get("processes_per_gpu") == 1,
        fps=speed["fps"],
        rasterizer=drawn,
        default_fps=next(iter(default.values()), speed["fps"]),
        default_rasterizer=next(iter(default), drawn),
        fps_alone=bool(quiet),
        render_bytes=memory["peak_render_bytes"],
        train_bytes=train.peak_bytes,
        memory_kind=memory["kind"],
        device=str((environment.get("gpu") or {}).get("name") or environment.get("cpu") or environment.get("device")),
        version=f"core {environment['packages'].get('splatwizard-core', '?')}, {record.distribution}",
        protocol=record.protocol.id,
        date=record.date[:10],
        command=str(beside.get("command", "")),
        repetition=repetition,
    )  # fmt: skip


def _variant(preset: str | None, before: Mapping[str, str | None], plugins: PluginManager) -> str:
    """Name what sets a run apart from others of its method; before: preset of each scene that it was given."""
    own = "" if preset in ("paper", "quick", None) else str(preset)
    asked = {
        found
        for name, found in before.items()
        if found not in (None, preset if preset in plugins.methods.load(name).PRESETS else "paper")
    }
    return " ".join([*filter(None, [own]), *(f"{FROM}{found}" for found in sorted(map(str, asked)))])


def _drawn(drawn_by: Mapping[str, str]) -> str:
    """Name who drew, in brackets whose kernels those are."""
    return ", ".join(name if name == kernels else f"{name} ({kernels})" for name, kernels in sorted(drawn_by.items()))


def write(records: Iterable[SmallRecord], path: Path) -> None:
    """Write the records of one scene, one a line, in the order of their keys: the file is whole at any time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(asdict(record)) for record in sorted(records, key=lambda r: r.key)]
    beside = path.with_name(f"{path.name}.new")
    beside.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    beside.replace(path)


def read(path: Path) -> list[SmallRecord]:
    """Read the records of one scene. Raises SystemExit that names a line which is none."""
    found = []
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        try:
            values = json.loads(line)
        except ValueError as error:
            raise SystemExit(f"{path}, line {number}: {error}") from None
        if set(values) != {field.name for field in fields(SmallRecord)}:
            raise SystemExit(f"{path}, line {number}: the fields are not those of a small record: collect it again")
        found.append(SmallRecord(**values))
    return found


def merged(old: Iterable[SmallRecord], new: Iterable[SmallRecord]) -> list[SmallRecord]:
    """Put new records in the places of old ones with the same key."""
    return list(({record.key: record for record in old} | {record.key: record for record in new}).values())
