"""Levels of detail of any file of Gaussians, or of a model."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from sw_gaussians.simplifying import level_counts, merged_to
from sw_gaussians.surfels import refuse_surfels
from sw_interchange.bridge import from_gaussians
from sw_interchange.known_formats import INDEX

from splatwizard_core.api import GaussianModel, SceneError, UserInputError
from splatwizard_core.tooling import (
    OUTPUT_FOLDER,
    choose_device,
    existing_file,
    load_plugins,
    open_model,
    read_gaussians,
)
from sw_lod.streamed import write_streamed

CHUNK = 65_536
SMALLEST_CHUNK = 256
FAINTEST = 1 / 255
"""Opacity below which a Gaussian is never drawn."""


def write_lod(
    given: str | os.PathLike[str] | GaussianModel, out: str | os.PathLike[str], *, levels: int | None = None,
    chunk: int = CHUNK, device: str = "auto", say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """Write a scene in levels, each half as many Gaussians as the finer one, merged from it, and in places.

    given   a splat file, or a model of Gaussians
    out     DIR/lod-meta.json: streamed SOG, as the SuperSplat viewer takes it; DIR is made if need be
    levels  how many; None: down to a 64th of the scene, or to 20,000 Gaussians if that is more
    chunk   Gaussians of a place at most, all levels together

    Returns the record. Raises UserInputError, SceneError, BitstreamError.
    """
    started = time.perf_counter()
    target = _target(out)
    if levels is not None and not 1 <= levels <= 64:
        raise UserInputError(f"--levels {levels}: 1 to 64 are possible")
    if chunk < SMALLEST_CHUNK:
        raise UserInputError(f"--chunk {chunk}: at least {SMALLEST_CHUNK}")
    model, name = _opened(given, device)
    counts = level_counts(model.num_rows, levels)
    scenes = [from_gaussians(model)]
    for level, count in enumerate(counts[1:], 1):
        model = merged_to(model, count)
        scenes.append(from_gaussians(model))
        say(f"level {level}: {count:,} Gaussians")
    merged = time.perf_counter()
    target.parent.mkdir(parents=True, exist_ok=True)
    facts = write_streamed(scenes, target, chunk=chunk, say=say)
    ended = time.perf_counter()
    seconds = {"merge": round(merged - started, 3), "write": round(ended - merged, 3)}
    return {"source": {"file": name, "gaussians": scenes[0].num_gaussians}, "out": str(target), **facts,
            "seconds": seconds}  # fmt: skip


def _target(out: str | os.PathLike[str]) -> Path:
    target = Path(out)
    if target.name != INDEX:
        raise UserInputError(f"{target}: levels are written as DIR/{INDEX}: name that file, in a folder of its own")
    if target.is_dir():
        raise UserInputError(f"{target} is a folder: give the name of a file in it")
    OUTPUT_FOLDER.check(target.parent)
    return target


def _opened(given: str | os.PathLike[str] | GaussianModel, device: str) -> tuple[GaussianModel, str]:
    """The drawn Gaussians on a device, and what messages call them."""
    plugins = load_plugins()
    chosen = choose_device(device, plugins)
    if isinstance(given, GaussianModel):
        return _drawn(given, "scene").to(chosen), "scene"
    path = existing_file(str(given))
    if plugins.importers.of_suffix(path) is not None:
        return _drawn(read_gaussians(path, plugins), path.name).to(chosen), path.name
    model, reader = open_model(path, plugins, torch.device("cpu"))
    if not isinstance(model, GaussianModel):
        raise UserInputError(
            f"{path.name}: Gaussians of method '{reader.method}' depend on the camera: `sw bake` makes explicit ones"
        )
    return _drawn(model, path.name).to(chosen), path.name


@torch.no_grad()
def _drawn(model: GaussianModel, name: str) -> GaussianModel:
    refuse_surfels(model, f"{name}: `sw lod`")
    raw = {key: getattr(model, key).detach() for key in model.RAW}
    keep = raw["opacity_logits"].sigmoid() >= FAINTEST
    for values in raw.values():
        keep &= torch.isfinite(values.flatten(1) if values.dim() > 1 else values[:, None]).all(dim=1)
    if not bool(keep.any()):
        raise SceneError(f"{name}: holds no Gaussian that could be seen")
    kept = type(model)(**{key: values[keep] for key, values in raw.items()}, active_sh_degree=model.active_sh_degree)
    kept.origin = model.origin
    return kept.eval().requires_grad_(False)
