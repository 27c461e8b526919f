"""log.jsonl as curves: loss, counts, and what tasks recorded over the steps, thinned to what a chart can show."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sw_report.facts import clean
from sw_report.runs import Run

POINTS = 240  # a chart is about 400 px wide
LONGEST_LINE = 1_000_000
MOST_LINES = 2_000_000
MOST_CURVES = 12  # that tasks recorded; a page needs an end
LONGEST_NAME = 64


@dataclass(frozen=True)
class TrainingCurves:
    """Curves of a training, from its log.

    loss        (step, mean loss of the logged steps since the point before), at most POINTS points
    counts      unit -> (step, number of them)
    scalars     name -> (step, value), the first MOST_CURVES that tasks recorded
    stages      (first step, index) of each stage; steps count on over stages
    lines       of the log that hold a loss
    damaged     lines that could not be read
    missing     why there is no curve, else None
    quality     metric -> (seconds of training, value) of the evaluations while it trained; none without `eval_every`
    """

    loss: list[tuple[float, float]]
    counts: dict[str, list[tuple[float, float]]]
    stages: list[tuple[int, int]]
    lines: int = 0
    damaged: int = 0
    missing: str | None = None
    scalars: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    quality: dict[str, list[tuple[float, float]]] = field(default_factory=dict)


def log_path(run: Run) -> Path:
    """Path of the log of a run's training, which may lie with the rate point beside it whose training it shares."""
    own = run.directory / "log.jsonl"
    home = run.facts.train.trained_in
    if home is None or own.is_file() or home == run.facts.rate or Path(home).name != home:
        return own
    return run.directory.parent / home / "log.jsonl"


def read_training(path: Path, points: int = POINTS) -> TrainingCurves:
    """Read the curves of a log; a damaged line is counted and passed over, a missing file is said."""
    losses: list[tuple[float, float]] = []
    counts: dict[str, list[tuple[float, float]]] = {}
    scalars: dict[str, list[tuple[float, float]]] = {}
    quality: dict[str, list[tuple[float, float]]] = {}
    stages: list[tuple[int, int]] = []
    damaged, before, last = 0, 0, 0
    if not path.is_file():
        return TrainingCurves([], {}, [], missing="no log.jsonl")
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), "")):
                if number >= MOST_LINES:
                    break
                entry = _entry(line)
                if entry is None:
                    damaged += 1
                    continue
                stage, step = entry["stage"], entry["step"]
                if not stages or stage != stages[-1][1]:
                    before = last
                    stages.append((before, stage))
                last = before + step
                if _is_number(entry.get("loss")):
                    losses.append((float(last), float(entry["loss"])))
                for key in entry:
                    known = key in counts or len(counts) < MOST_CURVES
                    if key.startswith("num_") and known and _is_number(entry[key]):
                        counts.setdefault(key, []).append((float(last), float(entry[key])))
                for name, value in _numbers(entry.get("scalars")):
                    if name in scalars or len(scalars) < MOST_CURVES:
                        scalars.setdefault(name, []).append((float(last), value))
                if _is_number(entry.get("train_s")):
                    for name, value in _numbers(entry.get("metrics")):
                        if name in quality or len(quality) < MOST_CURVES:
                            quality.setdefault(name, []).append((float(entry["train_s"]), value))
    except OSError as error:
        return TrainingCurves([], {}, [], missing=clean(f"log.jsonl: {error.strerror}"))
    if not (losses or counts or scalars):
        return TrainingCurves([], {}, stages, damaged=damaged, missing="log.jsonl holds no step")
    return TrainingCurves(
        thin(losses, points),
        {key: thin(values, points) for key, values in counts.items()},
        stages,
        len(losses),
        damaged,
        scalars={name: thin(values, points) for name, values in scalars.items()},
        quality={name: thin(values, points) for name, values in quality.items()},
    )


def thin(values: list[tuple[float, float]], points: int) -> list[tuple[float, float]]:
    """At most `points` points: means over runs of equally many neighbours; the first and the last stay themselves."""
    if len(values) <= points:
        return values
    inner = values[1:-1]
    size = len(inner) / (points - 2)
    found = [values[0]]
    for i in range(points - 2):
        group = inner[int(i * size) : max(int((i + 1) * size), int(i * size) + 1)]
        found.append((group[-1][0], sum(v for _, v in group) / len(group)))
    return [*found, values[-1]]


def _entry(line: str) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    fine = isinstance(entry, dict) and all(
        type(entry.get(key)) is int and 0 <= entry[key] < 2**53 for key in ("stage", "step")
    )
    return entry if fine else None


def _numbers(found: object) -> list[tuple[str, float]]:
    """Return the points of curves that a line has under a key; what is no number is none."""
    pairs = found.items() if isinstance(found, dict) else ()
    return [(clean(name)[:LONGEST_NAME], float(value)) for name, value in pairs if _is_number(value)]


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300 and math.isfinite(value)
