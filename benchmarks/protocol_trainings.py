"""Trainings that the tables about protocols need: one model for each scene, and one scene with two splits."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from protocol_jobs import SW
from sweep_cells import Cell

BLACK = "background=black"
MODEL_RATE = "r6"  # of 3dgs: float32, as trained
SPLIT_SCENE, SECTOR = "room", "sector:60@130"
SPLIT_METHODS = (("3dgs", MODEL_RATE, 30_000), ("hac-plus", "r4", 30_000), ("cat-3dgs", "r6", 40_000),
                 ("wisp", "r3", 18_000))  # fmt: skip
"""Method, its default rate point (3dgs: without a loss), steps of preset paper."""
STARTS = {"wisp": 30_000}  # steps of the 3DGS scene that it starts from
FULL_STEPS = 30_000


def training_cells(data: Path, scenes: Sequence[str], steps: int | None) -> list[Cell]:
    """Every training that the tables need."""
    cells = [Cell("3dgs", "3dgs", str(data / scene), MODEL_RATE, sets=(*black(data, scene), *_scaled("3dgs", steps)))
             for scene in scenes]  # fmt: skip
    for method, rate, _ in SPLIT_METHODS if SPLIT_SCENE in scenes else ():
        room, sets = str(data / SPLIT_SCENE), _scaled(method, steps)
        cells.append(Cell(method, method, room, rate, sets=sets))
        cells.append(Cell(f"{method}-sector", method, room, rate, sets=(f"split={SECTOR}", *sets)))
    return list(dict.fromkeys(cells))


def black(data: Path, scene: str) -> tuple[str, ...]:
    return (BLACK,) if (data / scene / "transforms_test.json").is_file() else ()


def _scaled(method: str, steps: int | None) -> tuple[str, ...]:
    if steps is None:
        return ()
    full = next(n for name, _, n in SPLIT_METHODS if name == method)
    own = ("scale_schedule=true", f"iterations={round(full * steps / FULL_STEPS)}")
    if method not in STARTS:
        return own
    return (*own, "pretrained.scale_schedule=true", f"pretrained.iterations={steps}")


def model_of(scene: str, args: argparse.Namespace) -> Path | None:
    """Find a scene's trained model, .ply: that of --models, else the training's, exported once; None: neither."""
    if args.models is not None and (given := args.models / f"{scene}.ply").is_file():
        return given
    kept = args.out / "models" / f"{scene}.ply"
    trained = Cell("3dgs", "3dgs", str(args.data / scene), MODEL_RATE).directory(args.out / "train") / "scene.swz"
    if trained.is_file() and not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([*SW, "export", str(trained), str(kept)], check=True, stdout=sys.stderr)
    return kept if kept.is_file() else None
