"""Checkpoints of trainers: gsplat, nerfstudio (splatfacto) and the authors' 3DGS.

They are pickles: torch unpickles tensors and plain values alone, and refuses whatever would run code. Sources: the
public sources of nerfstudio-project/gsplat and nerfstudio-project/nerfstudio, and 3D Gaussian Splatting (arXiv
2308.04079).
"""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatwizard_core.api import SH_C0, BitstreamError, SceneError
from sw_interchange.archive import entries_of, read_entry
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.scene import GaussianScene, Limits, ReadReport
from sw_interchange.source import Source

_NERFSTUDIO = "_model.gauss_params."
_RANK = re.compile(r"(.*_rank)(0|[1-9]\d{0,3})(\.\w+)")
_COLUMNS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


def read_checkpoint(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a checkpoint. Raises BitstreamError if it is damaged or would run code, SceneError for other models."""
    scene = _read_one(source, limits, report)
    others = _other_ranks(source) if report.version == "gsplat" else []
    if not others:
        return scene
    report.warnings.append(f"read with it: {', '.join(path.name for path in others[:3])}"
                           f"{', ...' * (len(others) > 3)}: each GPU saved a part of the scene")  # fmt: skip
    parts, rows = [scene], scene.num_gaussians
    for path in others:
        part = Source.open(path)
        report.bytes += len(part.data)
        limits.check(rows, report.bytes, report.bytes, source.name)
        parts.append(_read_one(part, limits, ReadReport("checkpoint")))
        rows += parts[-1].num_gaussians
        if parts[-1].sh_degree != scene.sh_degree:
            raise BitstreamError(f"{part.name}: its SH degree is {parts[-1].sh_degree}, that of {source.name} is "
                                 f"{scene.sh_degree}: they are no parts of one scene")  # fmt: skip
        limits.check(rows, report.bytes, report.bytes, source.name)
    return GaussianScene(*(np.concatenate([getattr(part, column) for part in parts]) for column in _COLUMNS))


def _read_one(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode one file; `report` gets its kind."""
    found = _unpickled(source, limits)
    for name, parts_of in _KINDS.items():
        parts = parts_of(found, source.name)
        if parts is not None:
            report.version = name
            return _scene(parts, source.name, limits, report)
    raise SceneError(f"{source.name}: a checkpoint, of none of: {', '.join(_KINDS)}", path=str(source.path))


def _other_ranks(source: Source) -> list[Path]:
    """Files of the other GPUs of the same step, which lie beside that of one: ckpt_29999_rank0.pt, _rank1.pt, ...

    Raises SceneError if one between them is absent.
    """
    told = _RANK.fullmatch(source.path.name) if source.path else None
    if source.path is None or told is None:
        return []
    try:
        beside = [_RANK.fullmatch(name) for name in os.listdir(source.path.parent)]
    except OSError as error:
        raise SceneError(
            f"{source.name}: its folder, where other GPUs may have saved theirs, cannot be read: {error.strerror}",
            path=str(source.path),
        ) from error
    ranks = {int(each[2]) for each in beside if each and (each[1], each[3]) == (told[1], told[3])}
    if missing := set(range(max(ranks) + 1)) - ranks:
        raise SceneError(
            f"{source.name}: '{told[1]}{min(missing)}{told[3]}', which the GPU before it saved, is not beside it",
            path=str(source.path),
        )
    return [source.path.with_name(f"{told[1]}{rank}{told[3]}") for rank in sorted(ranks - {int(told[2])})]


def _unpickled(source: Source, limits: Limits) -> Any:
    name = source.name
    if source.head(4) != b"PK\x03\x04":
        raise BitstreamError(f"{name}: not a checkpoint that torch 1.6 or later saved")
    entries = entries_of(source)
    sizes = [info.file_size for info in entries]
    # Storages are not compressed: none can be larger than the file.
    if sum(sizes) > len(source.data) or len(source.data) > limits.max_output_bytes:
        raise BitstreamError(f"{name}: its archive claims {sum(sizes):,} bytes, the file has {len(source.data):,}")
    for info in entries:
        if info.filename.endswith("data.pkl"):
            _check_pickle(read_entry(source, info), name)
    import torch

    try:
        return torch.load(io.BytesIO(source.data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise BitstreamError(
            f"{name}: holds more than tensors and plain values, and what that would run is not looked at"
        ) from error
    except Exception as error:  # torch raises many kinds for damaged files
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BitstreamError(f"{name}: a damaged checkpoint: {reason}") from error


def _check_pickle(content: bytes, name: str) -> None:
    """Refuse what makes much of few bytes: torch lets a pickle ask for a bytearray of any size."""
    try:
        asked = {str(value).rpartition(" ")[2] for opcode, value, _ in pickletools.genops(content)
                 if opcode.name == "GLOBAL"}  # fmt: skip
    except Exception as error:  # of many kinds, for damaged pickles
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BitstreamError(f"{name}: a damaged checkpoint: {reason}") from error
    if "bytearray" in asked:
        raise BitstreamError(f"{name}: holds more than tensors and plain values: a bytearray")


def _gsplat(found: Any, name: str) -> dict[str, Any] | None:
    splats = found.get("splats") if isinstance(found, Mapping) else None
    if not isinstance(splats, Mapping) or "means" not in splats:
        return None
    if "features" in splats:
        raise SceneError(f"{name}: its colours come from a network (appearance optimisation): there are no SH in it")
    keys = {"means": "means", "log_scales": "scales", "quats": "quats", "opacity_logits": "opacities",
            "sh_dc": "sh0", "sh_rest": "shN"}  # fmt: skip
    return {own: splats.get(theirs) for own, theirs in keys.items()}


def _nerfstudio(found: Any, name: str) -> dict[str, Any] | None:
    pipeline = found.get("pipeline") if isinstance(found, Mapping) else None
    if not isinstance(pipeline, Mapping):
        return None
    keys = {"means": "means", "log_scales": "scales", "quats": "quats", "opacity_logits": "opacities",
            "sh_dc": "features_dc", "sh_rest": "features_rest"}  # fmt: skip
    for prefix in (_NERFSTUDIO, "module." + _NERFSTUDIO, "_model.", "module._model."):
        if f"{prefix}means" in pipeline:
            return {own: pipeline.get(prefix + theirs) for own, theirs in keys.items()} | {"logit_colours": True}
    return None


def _inria(found: Any, name: str) -> dict[str, Any] | None:
    captured = found[0] if isinstance(found, tuple) and len(found) == 2 else None
    if not isinstance(captured, (tuple, list)) or len(captured) < 7:
        return None
    keys = ("means", "sh_dc", "sh_rest", "log_scales", "quats", "opacity_logits")
    return dict(zip(keys, captured[1:7], strict=True))


_KINDS: Mapping[str, Callable[[Any, str], dict[str, Any] | None]] = {
    "gsplat": _gsplat, "nerfstudio": _nerfstudio, "3DGS": _inria,
}  # fmt: skip


def _scene(parts: dict[str, Any], name: str, limits: Limits, report: ReadReport) -> GaussianScene:
    means = _array(parts, "means", name, limits)
    n = len(means)
    logit_colours = parts.pop("logit_colours", False)
    rest = _array(parts, "sh_rest", name, limits) if parts.get("sh_rest") is not None else np.zeros((n, 0, 3))
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,), "sh_dc": (n, 3)}
    columns = {}
    for key, shape in shapes.items():
        column = _array(parts, key, name, limits)
        if column.size != np.prod(shape):
            raise BitstreamError(f"{name}: '{key}' is {column.shape}, and there are {n:,} Gaussians")
        columns[key] = column.reshape(shape)
    if rest.ndim != 3 or rest.shape[::2] != (n, 3) or rest.shape[1] not in COEFFICIENTS.values():
        raise BitstreamError(f"{name}: 'sh_rest' is {rest.shape}, and there are {n:,} Gaussians")
    if logit_colours:
        report.warnings.append("its world is that of nerfstudio (re-oriented, centred, scaled): undo_dataparser")
        if rest.shape[1] == 0:  # trained without SH: colours are logits
            with np.errstate(over="ignore"):
                columns["sh_dc"] = ((1 / (1 + np.exp(-columns["sh_dc"])) - 0.5) / SH_C0).astype(np.float32)
    return GaussianScene(**columns, sh_rest=np.ascontiguousarray(rest, np.float32))


def _array(parts: dict[str, Any], key: str, name: str, limits: Limits) -> Array:
    import torch

    found = parts.get(key)
    if not isinstance(found, torch.Tensor) or found.layout != torch.strided or not found.dtype.is_floating_point:
        raise BitstreamError(f"{name}: '{key}' is no tensor of numbers")
    limits.check(len(found) if found.ndim else 0, 4 * found.numel(), 4 * found.numel(), name)
    # A view may be larger than what it is a view of, and a tensor of the device "meta" has no memory at all.
    if found.device.type != "cpu" or found.numel() * found.itemsize > found.untyped_storage().nbytes():
        raise BitstreamError(f"{name}: '{key}' claims {found.numel():,} numbers, more than are stored of it")
    return found.detach().float().contiguous().numpy()
