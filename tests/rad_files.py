"""Hand-made .rad files: what the format's text says, written with nothing of the reader."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rows = dict[str, NDArray[Any]]
DIMENSIONS = {"center": 3, "alpha": 1, "rgb": 3, "scales": 3, "orientation": 4, "sh1": 9, "sh2": 15, "sh3": 21}
PLAIN = dict.fromkeys(DIMENSIONS, "f32") | {"child_count": "u16", "child_start": "u32"}


def random_rows(count: int, degree: int = 1, seed: int = 0, *, tree: bool = False) -> Rows:
    """Rows [count,d] of each property; with a tree of pairs, the root first, breadth first."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    rows: Rows = {
        "center": rng.normal(size=(count, 3)), "alpha": rng.uniform(0.05, 0.95, (count, 1)),
        "rgb": rng.uniform(0, 1, (count, 3)), "scales": np.exp(rng.normal(size=(count, 3)) * 0.3 - 3),
        "orientation": quats / np.linalg.norm(quats, axis=1, keepdims=True),
    }  # fmt: skip
    for band in range(1, degree + 1):
        rows[f"sh{band}"] = rng.uniform(-0.5, 0.5, (count, 3 * (2 * band + 1)))
    if tree:
        assert count % 2
        inner = np.arange(count) < count // 2
        rows["child_count"] = np.where(inner, 2, 0)[:, None]
        rows["child_start"] = np.where(inner, 2 * np.arange(count) + 1, 0)[:, None]
        rows["scales"] *= 1 + count / (1 + np.arange(count)[:, None])  # parents are larger
    return rows


def encoded(values: NDArray[Any], encoding: str) -> tuple[bytes, dict[str, float]]:
    """Planes of values [n,d], and the bounds that the encoding needs."""
    if values.shape[1] == 4 and encoding != "oct88r8":  # x,y,z of a rotation; w follows, and is not negative
        values = values[:, :3] * np.where(values[:, 3:] < 0, -1, 1)
    planes = values.T.ravel()
    if encoding in ("u8", "u16", "u32"):
        return planes.astype(f"<u{ {'u8': 1, 'u16': 2, 'u32': 4}[encoding] }").tobytes(), {}
    kind = {"f32": "<f4", "f16": "<f2", "f32_lebytes": "<f4", "f16_lebytes": "<f2", "ln_f16": "<f2"}.get(encoding)
    if kind is not None:
        content = (np.log(planes) if encoding == "ln_f16" else planes).astype(kind)
        if encoding.endswith("_lebytes"):
            return np.ascontiguousarray(content.view(np.uint8).reshape(len(planes), -1).T).tobytes(), {}
        return content.tobytes(), {}
    if encoding == "oct88r8":
        return rotations(values).tobytes(), {}
    if encoding == "ln_0r8":
        low, high = float(np.log(planes).min()), float(np.log(planes).max())
        codes = np.rint((np.log(planes) - low) / (high - low) * 254 + 1).astype(np.uint8)
        return codes.tobytes(), {"min": low, "max": high}
    if encoding.startswith("s8"):
        high = float(np.abs(planes).max())
        codes, bounds = np.rint(planes / high * 127).astype(np.int8).view(np.uint8), {"min": -high, "max": high}
    else:
        low, high = float(planes.min()), float(planes.max())
        codes, bounds = np.rint((planes - low) / (high - low) * 255).astype(np.uint8), {"min": low, "max": high}
    if encoding.endswith("_delta"):
        columns = codes.reshape(-1, len(values))
        codes = np.diff(columns, axis=1, prepend=np.uint8(0)).ravel()
    return codes.tobytes(), bounds


def rotations(quats: NDArray[Any]) -> NDArray[np.uint8]:
    """Axis on the octahedron and angle of quaternions x,y,z,w."""
    quats = quats * np.where(quats[:, 3:] < 0, -1, 1)
    angle = 2 * np.arccos(np.clip(quats[:, 3], -1, 1))
    axis = quats[:, :3] / np.maximum(np.linalg.norm(quats[:, :3], axis=1, keepdims=True), 1e-9)
    axis = axis / np.abs(axis).sum(axis=1, keepdims=True)
    sign = np.where(axis[:, :2] < 0, -1, 1)
    flat = np.where(axis[:, 2:] < 0, (1 - np.abs(axis[:, 1::-1])) * sign, axis[:, :2])
    return np.concatenate([np.rint((flat + 1) * 127.5), np.rint(angle[:, None] / np.pi * 255)], axis=1).astype(np.uint8)


def padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % 8)


def framed(magic: bytes, description: dict[str, Any]) -> bytes:
    text = json.dumps(description).encode()
    return padded(magic + struct.pack("<I", len(text)) + text)


def deflated(content: bytes, wbits: int = -15) -> bytes:
    encoder = zlib.compressobj(6, zlib.DEFLATED, wbits)
    return encoder.compress(content) + encoder.flush()


def rad_chunk(rows: Rows, base: int, encodings: dict[str, str], *, wbits: int = -15, **changes: Any) -> bytes:
    """One chunk; `changes` replace entries of its description."""
    count, payload, listed = len(rows["center"]), b"", []
    for name, values in rows.items():
        content, bounds = encoded(values, encodings[name])
        packed = deflated(content, wbits)
        listed.append({"offset": len(payload), "bytes": len(packed), "property": name, "encoding": encodings[name],
                       "compression": "gz", **bounds})  # fmt: skip
        payload = padded(payload + packed)
    told = {"version": 1, "base": base, "count": count, "payloadBytes": len(payload), "maxSh": degree_of(rows),
            "lodTree": "child_count" in rows, "properties": listed, **changes}  # fmt: skip
    return padded(framed(b"RADC", told) + struct.pack("<Q", len(payload)) + payload)


def degree_of(rows: Rows) -> int:
    return sum(f"sh{band}" in rows for band in (1, 2, 3))


def rad_file(
    rows: Rows, encodings: dict[str, str] | None = None, *, chunk: int = 65536, wbits: int = -15, **changes: Any
) -> bytes:
    """A whole file; `changes` replace entries of its header."""
    count = len(rows["center"])
    parts, listed = [], []
    for base in range(0, count, chunk):
        piece = {name: values[base : base + chunk] for name, values in rows.items()}
        parts.append(rad_chunk(piece, base, PLAIN | (encodings or {}), wbits=wbits))
        listed.append({"offset": sum(map(len, parts[:-1])), "bytes": len(parts[-1]), "base": base,
                       "count": len(piece["center"])})  # fmt: skip
    header = {"version": 1, "type": "gsplat", "count": count, "maxSh": degree_of(rows),
              "lodTree": "child_count" in rows, "chunkSize": chunk, "allChunkBytes": sum(map(len, parts)),
              "chunks": listed, **changes}  # fmt: skip
    return framed(b"RAD0", header) + b"".join(parts)
