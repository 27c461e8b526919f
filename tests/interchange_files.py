"""Small scenes of Gaussians, files of them in every format, and damaged copies of these."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from sw_interchange import GaussianScene, encode
from sw_interchange.bands import COEFFICIENTS
from sw_interchange.ksplat import HEADER, SECTION_HEADER, _row_type


def random_scene(n: int, degree: int, seed: int = 0) -> GaussianScene:
    """Gaussians whose values lie within the ranges of all formats."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    quats = normal(n, 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return GaussianScene(
        means=3 * normal(n, 3),
        log_scales=np.clip(normal(n, 3) - 3, -9.9, 5.9),
        quats=quats,
        opacity_logits=3 * normal(n),
        sh_dc=np.clip(0.5 * normal(n, 3), -1.7, 1.7),
        sh_rest=np.clip(0.2 * normal(n, COEFFICIENTS[degree], 3), -0.95, 0.95),
    )


def covariances(scene: GaussianScene) -> np.ndarray:
    """[N,3,3] over their largest entry: quaternions of the same ellipsoid may differ by a half turn."""
    w, x, y, z = scene.quats.T.astype(np.float64)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip
    half = rotation * np.exp(scene.log_scales.astype(np.float64))[:, None]
    return half @ half.transpose(0, 2, 1)


def ksplat_file(n: int, level: int, degree: int, seed: int = 0) -> bytes:
    """A .ksplat of random records: two full buckets of n and a partial one of n // 2."""
    rng = np.random.default_rng(seed)
    row, count = _row_type(level, degree), 2 * n + n // 2
    rows = np.frombuffer(rng.integers(0, 256, row.itemsize * count, dtype=np.uint8).tobytes(), row).copy()
    for name in ("means", "scales", "quats", "sh"):
        if name in (row.names or ()) and rows[name].dtype.kind == "f":
            rows[name] = np.abs(rng.normal(size=rows[name].shape)) if name == "scales" else rng.normal(
                size=rows[name].shape)  # fmt: skip
    buckets = struct.pack("<I", n // 2) + rng.normal(size=(3, 3)).astype("<f4").tobytes() if level else b""
    main = struct.pack("<BBxxIIIIH", 0, 1, 1, 1, count, count, level).ljust(HEADER, b"\0")
    section = struct.pack("<IIIIf", count, count, n, 3 if level else 0, 5.0).ljust(24, b"\0")
    section += struct.pack("<IIIIH", 0, 0, 2 if level else 0, 1 if level else 0, degree)
    return main + section.ljust(SECTION_HEADER, b"\0") + buckets + rows.tobytes()


@dataclass(frozen=True)
class Sample:
    """A sound file.

    format  its name
    data    its bytes
    inner   what lies under its compression, if anything does, which a flip of `data` would not get past
    wrap    inner -> a file
    """

    format: str
    data: bytes
    inner: bytes = b""
    wrap: Callable[[bytes], bytes] = bytes


def samples() -> dict[str, Sample]:
    """Name -> a small file, of every format that is read but the checkpoints."""
    scene, coarse = random_scene(5, 1), random_scene(5, 0)
    files = {
        "ply": Sample("ply", encode(scene, "ply")[0]),
        "splat": Sample("splat", encode(coarse, "splat")[0]),
        "compressed-ply": Sample("compressed-ply", encode(scene, "compressed-ply")[0]),
        "ksplat": Sample("ksplat", ksplat_file(2, 1, 1)),
        "gltf": Sample("gltf", encode(scene, "gltf")[0]),
        "spz-v4": Sample("spz", encode(scene, "spz", version=4)[0]),
    }
    plain = gzip.decompress(spz := encode(scene, "spz")[0])
    files["spz"] = Sample("spz", spz, plain, lambda inner: gzip.compress(inner, 1))
    sog = encode(scene, "sog")[0]
    with zipfile.ZipFile(io.BytesIO(sog)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    lengths = [(name, len(content)) for name, content in members.items()]

    def zipped(inner: bytes) -> bytes:
        buffer, at = io.BytesIO(), 0
        with zipfile.ZipFile(buffer, "w") as archive:
            for name, length in lengths:
                archive.writestr(zipfile.ZipInfo(name), inner[at : at + length])
                at += length
        return buffer.getvalue()

    files["sog"] = Sample("sog", sog, b"".join(members.values()), zipped)
    return files


def mutants(sample: Sample, count: int, seed: int) -> Iterator[bytes]:
    """Damaged copies: bytes replaced (most often few of them), parts cut off, runs of 0 or 255."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        wrap, data = (
            (sample.wrap, bytearray(sample.inner)) if sample.inner and i % 2 else (bytes, bytearray(sample.data))
        )
        kind = rng.integers(8)
        if kind == 0:
            del data[int(rng.integers(len(data))) :]
        elif kind == 1:
            at = int(rng.integers(len(data)))
            data[at : at + 4] = bytes([255 * int(rng.integers(2))]) * 4
        else:
            # Headers are short, and most of the decisions: half of the flips go there.
            reach = min(len(data), 512) if rng.integers(2) else len(data)
            for _ in range(int(rng.integers(1, 4))):
                data[int(rng.integers(reach))] = int(rng.integers(256))
        yield wrap(bytes(data))
