"""Writing SOG, version 2: Morton order, two scalar codebooks, a palette of SH vectors, lossless WebP."""

from __future__ import annotations

import io
import json
import math
import zipfile
from typing import Any

import numpy as np

from splatwizard_core.api import UserInputError
from sw_interchange.bands import Array
from sw_interchange.clusters import nearest_entry, scalar_codebook, vector_palette
from sw_interchange.options import Options
from sw_interchange.order import morton_order
from sw_interchange.quats import ROOT_2, smallest_three
from sw_interchange.scene import GaussianScene, WriteReport, sigmoid
from sw_interchange.sog import BANDS, LARGEST_LOGARITHM, MAX_PALETTE, PALETTE_COLUMNS
from sw_interchange.webp import LARGEST_SIDE, Pixels, encode_image, tiled


class SogOptions(Options):
    """Options of `.sog`.

    palette     entries of the SH palette; None: 1,024 for each 1,024 Gaussians up to 65,536, a power of two
    iterations  of its k-means
    seed        of its start
    effort      of the WebP encoder, 0 (quick) to 6 (small)
    """

    palette: int | None = None
    iterations: int = 10
    seed: int = 0
    effort: int = 4
    choices = {
        "palette": (None, *range(1, MAX_PALETTE + 1)), "iterations": range(1, 101), "seed": range(1 << 32),
        "effort": range(7),
    }  # fmt: skip


def write_sog(scene: GaussianScene, options: SogOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene in RDF as a bundle. Raises UserInputError for one that no image of the format holds."""
    buffer = io.BytesIO()
    scene = scene.select(morton_order(scene.means))
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in sog_files(scene, options, report).items():
            # A date of its own for every run would make equal scenes differ.
            archive.writestr(zipfile.ZipInfo(name), content)
    return [buffer.getvalue()]


def sog_files(scene: GaussianScene, options: SogOptions, report: WriteReport) -> dict[str, bytes]:
    """Name -> content of the files, meta.json last, the rows as they are. Raises as `write_sog`."""
    n = scene.num_gaussians
    width = 4 * math.ceil(math.sqrt(n) / 4)
    height = 4 * math.ceil(n / width / 4)
    if width > LARGEST_SIDE:
        raise UserInputError(f"{n:,} Gaussians are too many for .sog: its images have up to {LARGEST_SIDE} columns")
    files: dict[str, bytes] = {}

    def image(name: str, *columns: Pixels) -> str:
        files[name] = encode_image(tiled(columns, width, height), options.effort)
        return name

    steps, bounds = _positions(scene.means)
    spans = np.subtract(bounds["maxs"], bounds["mins"])
    report.coarse(spans / 65535 * (1 + np.abs(scene.means.astype(np.float64))), scene.means, scene.log_scales)
    scales, dc = scalar_codebook(scene.log_scales), scalar_codebook(scene.sh_dc)
    alphas = np.clip(np.rint(255 * sigmoid(scene.opacity_logits)), 1, 255).astype(np.uint8)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "Splatwizard"},
        "count": n,
        **({"model": "2dgs"} if scene.kind == "2dgs" else {"model": "antialiased"} if scene.antialiased else {}),
        "means": {
            **bounds,
            "files": [image("means_l.webp", *_channels((steps & 255).astype(np.uint8))),
                      image("means_u.webp", *_channels((steps >> 8).astype(np.uint8)))],
        },
        "scales": {"codebook": scales.tolist(),
                   "files": [image("scales.webp", *_channels(nearest_entry(scene.log_scales, scales)))]},
        "quats": {"files": [image("quats.webp", *_quats(scene.quats))]},
        "sh0": {"codebook": dc.tolist(),
                "files": [image("sh0.webp", *_channels(nearest_entry(scene.sh_dc, dc)), alphas)]},
    }  # fmt: skip
    if scene.sh_degree:
        entries, labels = _palette(scene, options)
        codebook = scalar_codebook(entries)
        codes = nearest_entry(entries, codebook)
        report.errors["sh_rest_rmse"] = _rmse(scene.sh_rest.reshape(n, -1), codebook[codes], labels)
        files["shN_centroids.webp"] = encode_image(_palette_image(codes, BANDS[scene.sh_degree]), options.effort)
        label_bytes = ((labels & 255).astype(np.uint8), (labels >> 8).astype(np.uint8), np.zeros(n, np.uint8))
        meta["shN"] = {
            "count": len(entries), "bands": scene.sh_degree, "codebook": codebook.tolist(),
            "files": ["shN_centroids.webp", image("shN_labels.webp", *label_bytes)],
        }  # fmt: skip
    files["meta.json"] = json.dumps(meta, separators=(",", ":")).encode()
    return files


def _positions(means: Array) -> tuple[Any, dict[str, list[float]]]:
    """16-bit steps [N,3] of the logarithm of both signs, and its bounds."""
    y = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = y.min(0), y.max(0)
    if max(-low.min(), high.max()) > LARGEST_LOGARITHM:
        raise UserInputError(
            f"the scene reaches to {np.abs(means).max():.3g}: .sog holds coordinates up to "
            f"{math.expm1(LARGEST_LOGARITHM):.2g}"
        )
    span = np.where(high > low, high - low, 1)
    return np.rint((y - low) / span * 65535).astype(np.uint16), {"mins": low.tolist(), "maxs": high.tolist()}


def _channels(values: Pixels) -> list[Pixels]:
    return list(values.T)


def _quats(quats: Array) -> list[Pixels]:
    largest, others = smallest_three(quats)
    codes = np.clip(np.rint(np.float32(127.5) * (others * ROOT_2 + 1)), 0, 255).astype(np.uint8)
    return [*codes.T, (252 + largest).astype(np.uint8)]


def _palette(scene: GaussianScene, options: SogOptions) -> tuple[Array, Any]:
    n = scene.num_gaussians
    size = options.palette
    if size is None:
        size = 1024 * min(64, 2 ** int(math.log2(max(n / 1024, 1))))
    vectors = np.ascontiguousarray(scene.sh_rest.reshape(n, -1))
    return vector_palette(vectors, min(size, n), options.iterations, np.random.default_rng(options.seed))


def _rmse(vectors: Array, palette: Array, labels: Any) -> float:
    squares = 0.0
    for at in range(0, len(vectors), 1 << 16):
        part = slice(at, at + (1 << 16))
        squares += float(((vectors[part] - palette[labels[part]]) ** 2).sum(dtype=np.float64))
    return math.sqrt(squares / vectors.size)


def _palette_image(codes: Pixels, k: int) -> Pixels:
    """[rows, 64 K, 3] image of the codes [P, 3K]."""
    rows = math.ceil(len(codes) / PALETTE_COLUMNS)
    image = np.zeros((rows * PALETTE_COLUMNS, k, 3), np.uint8)
    image[: len(codes)] = codes.reshape(-1, k, 3)
    return image.reshape(rows, PALETTE_COLUMNS * k, 3)
