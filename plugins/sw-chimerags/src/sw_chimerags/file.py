"""The file: two groups of Gaussians, those whose mask is off (SH degree 2) and the others (degree 3).

Sections of a group `sh2`, `sh3`, rows in Morton order (docs/methods/chimerags.md); an empty group has none:

    xyz         `float-delta` of float32 [n,3]; float16: `byte-planes`; uniform16: `octree` with 16 bits, and `box`
    box         float64 [2,3]: lowest and highest coordinate, of `uniform16`
    attributes  float16 [n,8], `byte-planes`: opacity logit, three log scales, four quaternion components, raw
    vq/...      the parts of the vector coder: n vectors of 27 or 48 numbers, SH band 0, then channel by channel
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import BitstreamError, GaussianModel, SplatwizardError
from sw_chimerags.model import DEGREE, LOWER, MaskedGaussians
from sw_codecs.models.exchangeable import array_coder, codes_arrays

if TYPE_CHECKING:
    from splatwizard_core.api import ArrayCoder, ContainerReader, ContainerWriter, PluginManager, VectorCoder
    from sw_chimerags.config import Steps

GROUPS = {"sh2": LOWER, "sh3": (DEGREE + 1) ** 2 - 1}
"""Group -> coefficients behind band 0 that its Gaussians have, in the order of the decoded model."""

USUAL = "byte-planes"
"""The array coder of float16 where no other is named."""

POSITIONS = ("float32", "float16", "uniform16")
HALF_MAX = 65504.0
CELLS = 21  # bits an axis of the Morton codes
BITS = 16  # bits an axis of the positions `uniform16`
ROW_BYTES = 4 * (3 + 8 + 3 * (DEGREE + 1) ** 2)  # of a decoded Gaussian

Arrays = dict[str, NDArray[Any]]

codes_halves = partial(codes_arrays, dtypes=[np.float16])


def encode(
    model: MaskedGaussians,
    writer: ContainerWriter,
    plugins: PluginManager,
    *,
    coder: str,
    settings: Mapping[str, Mapping[str, Any]],
    steps: Steps,
    xyz: str,
    arrays: str = USUAL,
) -> None:
    """Write both groups; the model stays as it is.

    coder       name of the vector coder
    settings    group -> what its coder is made with
    steps       roundings before float16
    xyz         one of POSITIONS
    arrays      name of the array coder of float16

    Raises PluginError for a coder that there is not, SplatwizardError for values that are not finite and for a model
    whose importance is not that of its Gaussians.
    """
    if not model.has_importance():
        raise SplatwizardError(
            "the model was changed since the importance of its Gaussians was computed: `distill` computes it at its end"
        )
    rows_of = _rounded(_arrays(model), steps)
    on = model.mask_on().cpu().numpy()
    writer.raster["sh_degree"] = DEGREE
    writer.static.update(num_gaussians=len(on), num_sh3=int(on.sum()), max_sh_degree=DEGREE, vq=coder, xyz=xyz)
    if arrays != USUAL:
        writer.static["arrays"] = arrays
    planes = plugins.array_coders.load(arrays)()
    for group, rows in (("sh2", ~on), ("sh3", on)):
        if rows.any():
            own = {name: array[rows] for name, array in rows_of.items()}
            ordered = _in_order(own, plugins, BITS if xyz == "uniform16" else CELLS)
            vectors = plugins.vector_coders.load(coder)(plugins, **settings.get(group, {}))
            vectors.device = model.device  # a codebook is trained many times faster on the model's GPU
            _write_group(group, ordered, writer, plugins, vectors, xyz, planes)
    writer.allow(ROW_BYTES * len(on), f"a model of {len(on):,} Gaussians")


def _arrays(model: MaskedGaussians) -> Arrays:
    """The tensors and the importance on the host; float16 will hold their values."""
    found: Arrays = {}
    for name in GaussianModel.RAW:
        array = getattr(model, name).detach().float().cpu().numpy()
        if not np.isfinite(array).all():
            rows = int((~np.isfinite(array)).reshape(len(array), -1).any(1).sum())
            raise SplatwizardError(f"'{name}' of {rows:,} Gaussians is not finite: they cannot be encoded")
        found[name] = array if name == "means" else array.clip(-HALF_MAX, HALF_MAX)
    found["importance"] = model.importance.double().cpu().numpy()
    return found


def _rounded(arrays: Arrays, steps: Steps) -> Arrays:
    """Round what the file holds in float16 to coarser lattices, where a step is given."""
    found = dict(arrays)
    if steps.quats > 0:
        quats = arrays["quats"]
        quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
        found["quats"] = quats * np.where(quats[:, :1] < 0, -1, 1)
    for name, step in (
        ("sh_dc", steps.colors), ("sh_rest", steps.colors), ("opacity_logits", steps.opacity),
        ("log_scales", steps.scales), ("quats", steps.quats),
    ):  # fmt: skip
        if step > 0:
            found[name] = (np.rint(found[name].astype(np.float64) / step) * step).astype(np.float32)
    return found


def _in_order(arrays: Arrays, plugins: PluginManager, bits: int) -> Arrays:
    """Rows along a Morton curve through their own bounding box, x in the lowest bit; `cells` [n,3] are their places."""
    points = arrays["means"].astype(np.float64)
    low = points.min(0)
    width = np.maximum(points.max(0) - low, 1e-300)
    cells = np.rint((points - low) / width * ((1 << bits) - 1)).astype(np.int64)
    order = plugins.position_codecs.load("octree")().sort(cells)
    return {name: array[order] for name, array in {**arrays, "cells": cells}.items()}


def _write_group(
    group: str, arrays: Arrays, writer: ContainerWriter, plugins: PluginManager, coder: VectorCoder, xyz: str,
    planes: ArrayCoder,
) -> None:  # fmt: skip
    means, rest = arrays["means"], arrays["sh_rest"][:, : GROUPS[group]]
    if xyz == "float32":
        writer.add(f"{group}/xyz", plugins.array_coders.load("float-delta")().encode(means))
    elif xyz == "float16":
        writer.add(f"{group}/xyz", planes.encode(means.clip(-HALF_MAX, HALF_MAX).astype(np.float16)))
    else:
        writer.add_array(f"{group}/box", np.stack([means.min(0), means.max(0)]).astype(np.float64))
        writer.add(f"{group}/xyz", plugins.position_codecs.load("octree")().encode(arrays["cells"], BITS))
    columns = [arrays["opacity_logits"][:, None], arrays["log_scales"], arrays["quats"]]
    writer.add(f"{group}/attributes", planes.encode(np.concatenate(columns, 1).astype(np.float16)))
    n = len(means)
    colors = np.concatenate([arrays["sh_dc"].reshape(n, 3), rest.transpose(0, 2, 1).reshape(n, -1)], 1)
    for part, data in coder.encode(colors, arrays["importance"]).items():
        writer.add(f"{group}/vq/{part}", data)


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model of a file. Raises BitstreamError."""
    total = reader.integer("num_gaussians", low=0, high=2**32 - 1)
    on = reader.integer("num_sh3", low=0, high=total)
    reader.integer("max_sh_degree", low=DEGREE, high=DEGREE)
    reader.allow(ROW_BYTES * total, f"a model of {total:,} Gaussians")
    xyz = reader.text("xyz", choices=POSITIONS)
    coder = plugins.vector_coders.load(reader.text("vq", choices=plugins.vector_coders.names))(plugins)
    planes = array_coder(reader, plugins, "arrays", USUAL)
    groups = [
        _read_group(group, n, reader, plugins, coder, xyz, planes) for group, n in (("sh2", total - on), ("sh3", on))
    ]
    tensors = [torch.cat([group[i] for group in groups]) for i in range(len(GaussianModel.RAW))]
    return GaussianModel(*tensors, active_sh_degree=DEGREE)


def _read_group(
    group: str, n: int, reader: ContainerReader, plugins: PluginManager, coder: VectorCoder, xyz: str,
    planes: ArrayCoder,
) -> list[Tensor]:  # fmt: skip
    """The tensors of a group in the order of RAW; bands that it lacks are zero."""
    rest = np.zeros((n, GROUPS["sh3"], 3), np.float32)
    if n == 0:
        vectors, attributes, means = np.zeros((0, 3 + 3 * GROUPS[group])), np.zeros((0, 8)), np.zeros((0, 3))
    else:
        means = _positions(group, n, reader, plugins, xyz, planes)
        with reader.decoding(f"{group}/attributes") as data:
            attributes = _finite(planes.decode(data, np.float16, (n, 8)))
        vectors = _vectors(group, n, 3 + 3 * GROUPS[group], reader, coder)
    rest[:, : GROUPS[group]] = vectors[:, 3:].reshape(n, 3, GROUPS[group]).transpose(0, 2, 1)
    found = (means, vectors[:, None, :3], rest, attributes[:, 0], attributes[:, 1:4], attributes[:, 4:])
    return [torch.from_numpy(np.require(array, np.float32, ["C", "W"])) for array in found]


def _positions(
    group: str, n: int, reader: ContainerReader, plugins: PluginManager, xyz: str, planes: ArrayCoder
) -> NDArray[Any]:
    if xyz == "float32":
        with reader.decoding(f"{group}/xyz") as data:
            return _finite(plugins.array_coders.load("float-delta")().decode(data, np.float32, (n, 3)))
    if xyz == "float16":
        with reader.decoding(f"{group}/xyz") as data:
            return _finite(planes.decode(data, np.float16, (n, 3)))
    low, high = reader.array(f"{group}/box", dtype="float64", shape=(2, 3), finite=True)
    with reader.decoding(f"{group}/xyz") as data:
        cells = plugins.position_codecs.load("octree")(max_points=n).decode(data)
        if len(cells) != n or cells.max() >= 1 << BITS:
            raise BitstreamError(f"{len(cells):,} points of up to {int(cells.max(initial=0)):,}, expected {n:,}")
        with np.errstate(over="ignore", invalid="ignore"):
            return _finite((low + cells / ((1 << BITS) - 1) * (high - low)).astype(np.float32))


def _vectors(group: str, n: int, d: int, reader: ContainerReader, coder: VectorCoder) -> NDArray[Any]:
    prefix = f"{group}/vq/"
    parts = {name.removeprefix(prefix): reader.section(name) for name in reader.sections if name.startswith(prefix)}
    if not parts:
        raise BitstreamError(f"{reader.name}: there is no section {prefix}...")
    first = prefix + next(iter(parts))
    with reader.decoding(first):
        found = np.asarray(coder.decode(parts, n, d))
        if found.shape != (n, d):
            raise BitstreamError(f"the coder of vectors gave {list(found.shape)}, expected {[n, d]}")
        return _finite(found)


def _finite(array: NDArray[Any]) -> NDArray[Any]:
    if not np.isfinite(array).all():
        raise BitstreamError("holds values that are not finite")
    return array
