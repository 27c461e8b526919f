"""Hand-made .lcc scenes: what the format's text says, written with nothing of the reader."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

ROW = np.dtype([("means", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("scales", "<u2", 3),
                ("rotation", "<u4"), ("normal", "<u2", 3)])  # fmt: skip
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def write_lcc(folder: Path, *, count: int = 40, degree: int = 3, seed: int = 0) -> dict[str, Any]:
    """Write meta.lcc, index.bin, data.bin and shcoef.bin of two cells and two levels: three quarters and one.

    Returns means, log scales, unit quaternions (w,x,y,z), opacities 0..1, colours 0..1 and SH of all rows.
    """
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    rows["means"] = rng.normal(size=(count, 3))
    rows["color"], rows["opacity"] = rng.integers(0, 256, (count, 3)), rng.integers(1, 255, count)
    rows["scales"] = rng.integers(1, 65536, (count, 3))
    quats = rng.normal(size=(count, 4))  # x,y,z,w
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.sign(quats[np.arange(count), largest])[:, None]
    others = quats[np.arange(count)[:, None], OTHERS[largest]]
    codes = np.rint((others + np.sqrt(0.5)) / np.sqrt(2) * 1023).astype(np.uint32)
    rows["rotation"] = codes[:, 0] | codes[:, 1] << 10 | codes[:, 2] << 20 | largest.astype(np.uint32) << 30
    (folder / "data.bin").write_bytes(rows.tobytes())
    fine = 3 * count // 4
    ends = [0, fine // 2, fine, fine + (count - fine) // 2, count]
    index = b""
    for cell in (0, 1):
        index += struct.pack("<hh", cell, 0)
        for start, end in ((ends[cell], ends[cell + 1]), (ends[2 + cell], ends[3 + cell])):
            index += struct.pack("<iqi", end - start, 32 * start, 32 * (end - start))
    (folder / "index.bin").write_bytes(index)
    attributes: list[dict[str, Any]] = [{"name": "scale", "min": [0.001, 0.002, 0.003], "max": [0.1, 0.2, 0.3]}]
    low, high = -1.5, 1.25
    coefficients = rng.integers(0, [2048, 1024, 2048], (count, 15, 3))
    attributes.append({"name": "shcoef", "min": [low] * 3, "max": [high] * 3})
    if degree:
        words = np.zeros((count, 16), np.uint32)
        words[:, :15] = coefficients[..., 0] | coefficients[..., 1] << 11 | coefficients[..., 2] << 21
        (folder / "shcoef.bin").write_bytes(words.tobytes())
    meta = {
        "version": "5.0", "name": "made here", "source": "lcc", "totalSplats": count, "totalLevel": 2,
        "offset": [0] * 3,
        "cellLengthX": 30, "cellLengthY": 30, "indexDataSize": len(index), "splats": [fine, count - fine],
        "shift": [0] * 3, "scale": [1] * 3, "boundingBox": {"min": [-9] * 3, "max": [9] * 3}, "encoding": "COMPRESS",
        "fileType": "Quality" if degree else "Portable", "attributes": attributes,
    }  # fmt: skip
    (folder / "meta.lcc").write_text(json.dumps(meta))
    least, most = np.array(attributes[0]["min"]), np.array(attributes[0]["max"])
    return {
        "meta": meta, "means": rows["means"], "quats": quats[:, [3, 0, 1, 2]], "opacities": rows["opacity"] / 255,
        "log_scales": np.log(least + (most - least) * rows["scales"] / 65535), "colors": rows["color"] / 255,
        "sh_rest": low + (high - low) * coefficients / [2047, 1023, 2047],
    }  # fmt: skip
