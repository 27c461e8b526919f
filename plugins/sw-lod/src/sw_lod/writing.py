"""Levels of detail of any file of Gaussians, or of a model."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.render_options import raster_of
from sw_gaussians.simplifying import level_counts, merged_to
from sw_gaussians.surfels import refuse_surfels
from sw_interchange.bridge import from_gaussians
from sw_interchange.known_formats import INDEX

from splatwizard_core.api import (
    ContainerReader,
    GaussianModel,
    SceneError,
    UserInputError,
    create_method,
)
from splatwizard_core.tooling import (
    OUTPUT_FOLDER,
    choose_device,
    encode,
    existing_file,
    load_plugins,
    open_model,
    read_gaussians,
)
from sw_lod.streamed import write_streamed
from sw_lod.worth import Worth

SWZ = ".swz"
CHUNK = 65_536
SMALLEST_CHUNK = 256
FAINTEST = 1 / 255
"""Opacity below which a Gaussian is never drawn."""


def write_lod(
    given: str | os.PathLike[str] | GaussianModel, out: str | os.PathLike[str], *, levels: int | None = None,
    chunk: int | None = None, device: str = "auto", say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """Write a scene in levels, each half as many Gaussians as the finer one, merged from it, and in places.

    given   a splat file, or a model of Gaussians
    out     DIR/lod-meta.json: streamed SOG, as the SuperSplat viewer takes it; DIR is made if need be. Or FILE.swz:
            coarse first, then place by place, by the codec `gaussians-tiles`
    levels  how many; None: down to a 64th of the scene, or to 20,000 Gaussians if that is more. Not of a .swz
    chunk   Gaussians of a place at most, all levels together; None: 65,536, in a .swz 16,384

    Returns the record. Raises UserInputError, SceneError, BitstreamError.
    """
    started = time.perf_counter()
    target = _target(out)
    if not isinstance(given, GaussianModel) and target.exists() and target.samefile(existing_file(str(given))):
        raise UserInputError(f"{target} is the file that is read: give --out another name")
    if levels is not None and not 1 <= levels <= 64:
        raise UserInputError(f"--levels {levels}: 1 to 64 are possible")
    if chunk is not None and chunk < SMALLEST_CHUNK:
        raise UserInputError(f"--chunk {chunk}: at least {SMALLEST_CHUNK}")
    if target.suffix == SWZ:
        if levels is not None:
            raise UserInputError(f"--levels {levels}: a {SWZ} has the scene and what comes first of it, no levels")
        return _write_tiles(given, target, chunk, device, started)
    model, name = _opened(given, device)
    counts = level_counts(model.num_rows, levels)
    models = [model]
    for level, count in enumerate(counts[1:], 1):
        models.append(merged_to(models[-1], count, widen=True))
        say(f"level {level}: {count:,} Gaussians")
    merged = time.perf_counter()
    shares = _shares(models) if len(models) > 1 else []
    measured = time.perf_counter()
    scenes = [from_gaussians(each) for each in models]
    is_new = not target.parent.exists()
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        facts = write_streamed(scenes, target, chunk=chunk or CHUNK, shares=shares, say=say)
    except BaseException:  # an interrupt too: half of a scene is no use to anybody
        if is_new:
            shutil.rmtree(target.parent, ignore_errors=True)
        raise
    if levels is None and len(counts) == 1:
        say(f"{counts[0]:,} Gaussians are few: there is one level; --levels makes more")
    ended = time.perf_counter()
    seconds = {"merge": round(merged - started, 3), "measure": round(measured - merged, 3),
               "write": round(ended - measured, 3)}  # fmt: skip
    return {"source": {"file": name, "gaussians": scenes[0].num_gaussians}, "out": str(target), **facts,
            "seconds": seconds}  # fmt: skip


def _shares(models: list[GaussianModel]) -> list[NDArray[np.float64]]:
    """Errors of levels in pictures from cameras that are made up, as `write_streamed` takes them."""
    worth = Worth(models[0], raster_of(models[0]), load_plugins())
    return [worth.energies(models[0]), *(worth.errors(each) for each in models[1:])]


def _write_tiles(
    given: str | os.PathLike[str] | GaussianModel, target: Path, chunk: int | None, device: str, started: float
) -> dict[str, Any]:
    model, name = _opened(given, device)
    values = {"codec.name": "gaussians-tiles", **({} if chunk is None else {"codec.settings.rows": chunk})}
    origin = model.world_origin or (0.0, 0.0, 0.0)
    facts = encode(create_method(load_plugins(), "3dgs", values), model, raster_of(model), target, origin)
    ends = [cut["bytes"] for cut in ContainerReader.open(target).summary()["cuts"]]
    return {"source": {"file": name, "gaussians": model.num_rows}, "out": str(target), "bytes": facts.bytes,
            "packets": ends, "warnings": [], "seconds": {"write": round(time.perf_counter() - started, 3)}}  # fmt: skip


def _target(out: str | os.PathLike[str]) -> Path:
    target = Path(out)
    if target.name != INDEX and target.suffix != SWZ:
        raise UserInputError(f"{target}: levels are written as DIR/{INDEX}, in a folder of its own, or as FILE{SWZ}")
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
