"""The LCC format of XGRIDS: rows of 32 bytes by place and level, and spherical harmonics beside them. Read only.

`meta.lcc` is a description in JSON; `index.bin` says for each cell of a grid and each level where its rows lie in
`data.bin`; `shcoef.bin` has 64 bytes for each row. Level 0 is the finest. The world's z points up. Source: the
reader of splat-transform as documented, and its results on files made here.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import SH_C0, BitstreamError, UserInputError
from sw_interchange.bands import Array
from sw_interchange.known_formats import MAX_META
from sw_interchange.quats import ROOT_2, from_smallest_three
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, decoded_bytes, logit_of_byte
from sw_interchange.source import Source, json_reason

FRAME = "RFU"
MAX_LEVELS = 64
MAX_CELLS = 1 << 20
ROW = np.dtype([
    ("means", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("scales", "<u2", 3), ("rotation", "<u4"),
    ("normal", "<u2", 3),
])  # fmt: skip
SH_BYTES = 64
"""Of a row in shcoef.bin: 15 words of a coefficient in red, green and blue, and one to spare."""
LARGEST = 1e6
"""Of a bound of scales or coefficients."""


def read_lcc(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode level `source.level`. Raises BitstreamError, UserInputError for a level that is not there."""
    meta = _description(source)
    levels = meta.get("totalLevel")
    if type(levels) is not int or not 1 <= levels <= MAX_LEVELS:
        raise BitstreamError(f"{source.name}: 'totalLevel' is {levels!r:.20}; 1 to {MAX_LEVELS} are possible")
    if not 0 <= source.level < levels:
        raise UserInputError(f"{source.name}: has levels 0 to {levels - 1}, there is no level {source.level}")
    low, high = _range(source, meta, "scale")
    if low.min() < 0:
        raise BitstreamError(f"{source.name}: the range of its scales begins below 0")
    data = source.beside("data.bin")
    ranges = _ranges(source, levels, len(data))
    count = sum(points for _, points in ranges)
    # Portable files list the range of coefficients that they do not have.
    has_sh = _has_attribute(meta, "shcoef") and meta.get("fileType") != "Portable"
    report.bytes += 0 if data is None else len(data)
    limits.check(count, decoded_bytes(count, 15 if has_sh else 0), count * (96 if has_sh else 32), source.name)
    if count == 0:
        raise BitstreamError(f"{source.name}: level {source.level} holds no Gaussians")
    rows = np.concatenate([np.frombuffer(data, ROW, points, offset) for offset, points in ranges])
    scales = low + (high - low) * (rows["scales"] / 65535)
    with np.errstate(divide="ignore"):
        log_scales = np.maximum(np.log(scales), FLAT).astype(np.float32)
    if (source.path is not None) and (source.path.parent / "environment.bin").exists():
        report.warnings.append("its environment.bin is not read")
    return GaussianScene(
        means=rows["means"].astype(np.float32),
        log_scales=log_scales,
        quats=_quats(rows["rotation"]),
        opacity_logits=logit_of_byte(rows["opacity"]),
        sh_dc=((rows["color"] / 255 - 0.5) / SH_C0).astype(np.float32),
        sh_rest=_sh_rest(source, meta, ranges, report) if has_sh else np.zeros((count, 0, 3), np.float32),
        frame=FRAME,
    )


def _description(source: Source) -> dict[str, Any]:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number")

    if len(source.data) > MAX_META:
        raise BitstreamError(f"{source.name}: a description of more than {MAX_META:,} bytes")
    try:
        found = json.loads(bytes(source.data), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise BitstreamError(f"{source.name}: a damaged description: {json_reason(error)}") from error
    if not isinstance(found, dict) or not isinstance(found.get("attributes"), list):
        raise BitstreamError(f"{source.name}: no description of an LCC scene: it lists no attributes")
    return found


def _has_attribute(meta: dict[str, Any], name: str) -> bool:
    return any(isinstance(each, dict) and each.get("name") == name for each in meta["attributes"])


def _range(source: Source, meta: dict[str, Any], name: str) -> tuple[Array, Array]:
    """Lowest and highest values [3] of an attribute."""
    told = next((each for each in meta["attributes"] if isinstance(each, dict) and each.get("name") == name), {})
    found: list[npt.NDArray[Any]] = []
    for key in ("min", "max"):
        numbers = told.get(key)
        good = isinstance(numbers, list) and len(numbers) in (1, 3)
        if not good or not all(type(x) in (int, float) and abs(x) <= LARGEST for x in numbers or []):
            raise BitstreamError(f"{source.name}: '{key}' of attribute '{name}' is no list of three numbers")
        found.append(np.broadcast_to(np.array(numbers, np.float64), 3))
    if (found[1] < found[0]).any():
        raise BitstreamError(f"{source.name}: the range of attribute '{name}' ends before it begins")
    return found[0], found[1]


def _ranges(source: Source, levels: int, size: int) -> list[tuple[int, int]]:
    """Offset in data.bin and number of rows of each cell of the level, without the empty ones."""
    entry = np.dtype([("points", "<i4"), ("offset", "<i8"), ("bytes", "<i4")])
    cell = np.dtype([("place", "<i2", 2), ("levels", entry, levels)])
    index = source.beside("index.bin")
    if len(index) % cell.itemsize or len(index) > MAX_CELLS * cell.itemsize:
        raise BitstreamError(
            f"{source.name}: index.bin has {len(index):,} bytes, no multiple of {cell.itemsize} or too many"
        )
    entries = np.frombuffer(index, cell)["levels"].reshape(-1, levels)[:, source.level]
    entries = entries[entries["points"] != 0]
    points, offsets = entries["points"].astype(np.int64), entries["offset"].astype(np.int64)
    good = (points > 0) & (entries["bytes"] == 32 * points) & (offsets >= 0) & (offsets <= size - 32 * points)
    if not good.all():
        raise BitstreamError(f"{source.name}: index.bin names rows that data.bin, of {size:,} bytes, does not hold")
    order = np.argsort(offsets, kind="stable")
    if (offsets[order][1:] < (offsets + 32 * points)[order][:-1]).any():
        raise BitstreamError(f"{source.name}: two cells of index.bin share rows")
    return [(int(offset), int(number)) for offset, number in zip(offsets, points, strict=True)]


def _quats(words: npt.NDArray[np.uint32]) -> Array:
    """Unit quaternions w,x,y,z of three components, 10 bits each, and the index of the one left out of x,y,z,w."""
    codes = np.stack([words & 1023, words >> 10 & 1023, words >> 20 & 1023], axis=1).astype(np.float32)
    others = codes / np.float32(1023) * ROOT_2 - 1 / ROOT_2
    found = from_smallest_three((words >> 30).astype(np.intp), others)  # in the order x,y,z,w
    return np.ascontiguousarray(found[:, [3, 0, 1, 2]])


def _sh_rest(source: Source, meta: dict[str, Any], ranges: list[tuple[int, int]], report: ReadReport) -> Array:
    low, high = _range(source, meta, "shcoef")
    data = source.beside("shcoef.bin")
    report.bytes += len(data)
    if any(2 * offset + SH_BYTES * points > len(data) for offset, points in ranges):
        raise BitstreamError(f"{source.name}: shcoef.bin of {len(data):,} bytes does not reach to all rows of data.bin")
    words = np.concatenate([np.frombuffer(data, "<u4", 16 * points, 2 * offset) for offset, points in ranges])
    words = words.reshape(-1, 16)[:, :15]
    shares = np.stack([(words & 2047) / 2047, (words >> 11 & 1023) / 1023, (words >> 21) / 2047], axis=-1)
    return (low + (high - low) * shares).astype(np.float32)
