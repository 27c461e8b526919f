"""Records of trainings beside another trainer (docs/records/trainers/*.jsonl), and the table made from them."""

from __future__ import annotations

import json
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

OURS = "splatwizard"
NONE = "-"


@dataclass(frozen=True)
class Training:
    """Facts of one training; benchmarks/train_cuda.py --records writes them.

    trainer         "splatwizard", or another's name and version
    scene, plan     folder's name (FAMILY:name where that was asked for) and picture folder; "3dgs" (default density
                    control) or "mcmc"
    per_second      steps per second of the loop; None where other work was on the GPU
    gaussians       at the end; None: not counted
    peak_mib        peak of torch's allocator in the loop; None: not measured
    note            SSIM of the loss, who resets opacities
    """

    trainer: str
    scene: str
    plan: str
    steps: int
    seed: int
    psnr: float
    gaussians: int | None
    per_second: float | None
    peak_mib: float | None
    device: str
    date: str
    note: str


def read(path: Path) -> list[Training]:
    """Read records. Raises SystemExit that names a line which is none."""
    found = []
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        values = json.loads(line)
        if set(values) != {field.name for field in fields(Training)}:
            raise SystemExit(f"{path}, line {number}: the fields are not those of a training")
        found.append(Training(**values))
    return found


def table(path: Path) -> str:
    """Write ours beside the other trainer, a row for each scene, plan and number of steps, and where it comes from."""
    if not path.exists():
        return f"*No records of {path.stem} yet.*\n"
    groups: dict[tuple[str, str, int], dict[str, list[Training]]] = defaultdict(lambda: defaultdict(list))
    records = read(path)
    for r in records:
        groups[r.scene, r.plan, r.steps][r.trainer].append(r)
    (other,) = {r.trainer for r in records} - {OURS}
    head = ["scene", "plan", "steps", "PSNR dB, ours", other, "steps/s, ours", other, "ratio",
            "training MiB, ours", other, "n"]  # fmt: skip
    rows = []
    for (scene, plan, steps), sides in sorted(groups.items()):
        mine, theirs = sides[OURS], sides[other]
        ours_at, theirs_at = (_mean([r.per_second for r in side]) for side in (mine, theirs))
        ratio = f"{ours_at / theirs_at:.1f}" if ours_at and theirs_at else NONE
        rows.append([
            scene, plan, f"{steps:,}", _spread([r.psnr for r in mine]), _spread([r.psnr for r in theirs]),
            _whole(ours_at), _whole(theirs_at), ratio,
            _whole(_mean([r.peak_mib for r in mine])), _whole(_mean([r.peak_mib for r in theirs])),
            str(len(mine)) if len(mine) == len(theirs) else f"{len(mine)} / {len(theirs)}",
        ])  # fmt: skip
    lines = [f"| {' | '.join(row)} |" for row in rows]
    devices, dates = sorted({r.device for r in records}), sorted({r.date for r in records})
    notes = "; ".join(sorted({f"{r.trainer}: {r.note}" for r in records if r.note}))
    source = f"{', '.join(devices)}, {' to '.join(dict.fromkeys((dates[0], dates[-1])))}. {notes}".strip()
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *lines, "", f"{source}.", ""])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def _spread(values: Sequence[float]) -> str:
    if not values:
        return NONE
    mean = f"{statistics.fmean(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ± {statistics.stdev(values):.2f}"


def _whole(value: float | None) -> str:
    return NONE if value is None else f"{value:,.0f}"
