"""Compute the metrics of finished runs once more, with scikit-image and torchmetrics, and compare with metrics.json.

    python benchmarks/check_metrics.py out/fox/3dgs/r6 out/lego/3dgs/r6 out/mug/3dgs/r6

Uses none of our metrics and loaders; of ours only the import of torchvision, which torchmetrics wants where it is
installed, and whose CUDA wheel does not import unaided beside a CPU torch. The renders are the PNGs of the run
directory; the ground truth is read from the scene's own pictures by Pillow (COLMAP and Blender folders; the demo scene
has none on disk: `sw data synth` writes it). Neither library pads with zeros at the border, so both get pictures with
a black frame of half a window, and the pixels inside it are averaged: those see exactly the padding. Exit status 1 if
a value differs by more than 1e-3 dB (PSNR) or 1e-4 (others).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from sw_metrics.torchvision_import import import_torchvision

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if importlib.util.find_spec("torchvision") is not None:
    import_torchvision()
from torchmetrics.functional.image import (
    peak_signal_noise_ratio as torchmetrics_psnr,
)
from torchmetrics.functional.image import structural_similarity_index_measure

HALF_WINDOW = 5  # pixels, of the 11 x 11 window
TOLERANCE_DB = 1e-3
TOLERANCE = 1e-4
BACKGROUNDS = {"black": 0.0, "white": 1.0}


@dataclass(frozen=True)
class Row:
    """One metric of one run, three times: means over the views, and the largest difference in a single view."""

    run: str
    metric: str
    recorded: float
    scikit_image: float
    torchmetrics: float
    largest_difference: float

    @property
    def tolerance(self) -> float:
        return TOLERANCE_DB if self.metric.startswith("psnr") else TOLERANCE

    @property
    def agrees(self) -> bool:
        return self.largest_difference <= self.tolerance


def ground_truth(scene: Path, record: dict, view: str, size: tuple[int, int]) -> np.ndarray:
    """[H,W,3] float64 in 0..1: the photograph as the protocol wants it, at the size (width, height) of the render."""
    protocol = record["protocol"]
    blender = (scene / "transforms_test.json").is_file()
    path = scene / view if blender else scene / protocol["images"] / view
    if not path.is_file():
        raise SystemExit(f"{path}: no such picture; this script reads COLMAP and Blender folders (`sw data synth`)")
    with Image.open(path) as picture:
        if picture.size != size:
            picture = picture.resize(size, Image.Resampling.BICUBIC)
        pixels = np.asarray(picture.convert("RGBA" if "A" in picture.getbands() else "RGB"), dtype=np.float64) / 255
    if pixels.shape[2] == 3:
        return pixels
    if not blender and not protocol.get("masked"):
        return pixels[..., :3]
    if protocol.get("composite8"):
        raise SystemExit(f"{path}: pictures that were composited in 8 bit are not covered by this script")
    alpha = pixels[..., 3:]
    return pixels[..., :3] * alpha + BACKGROUNDS[protocol["background"]] * (1 - alpha)


def framed(image: np.ndarray) -> np.ndarray:
    """With zeros around, as far as a window reaches."""
    return np.pad(image, ((HALF_WINDOW, HALF_WINDOW), (HALF_WINDOW, HALF_WINDOW), (0, 0)))


def reflected(image: np.ndarray) -> np.ndarray:
    """With its own mirror image around, as far as a window reaches; the edge pixel is not repeated."""
    return np.pad(image, ((HALF_WINDOW, HALF_WINDOW), (HALF_WINDOW, HALF_WINDOW), (0, 0)), mode="reflect")


def scikit_ssim(render: np.ndarray, truth: np.ndarray) -> float:
    """Mean over the pixels at least half a window inside: the library's own convention."""
    return float(structural_similarity(
        render, truth, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    ))  # fmt: skip


def as_tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).float().permute(2, 0, 1)[None]


def torchmetrics_ssim(render: np.ndarray, truth: np.ndarray, *, inside: int = 0) -> float:
    """Mean over the pixels at least `inside` from the edge; the library mirrors the picture there, and averages all."""
    _, values = structural_similarity_index_measure(
        as_tensor(render), as_tensor(truth), data_range=1.0, return_full_image=True
    )  # [1,3,H,W]
    height, width = values.shape[2:]
    return float(values[..., inside : height - inside, inside : width - inside].double().mean())


def by_scikit_image(render: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    channels = [peak_signal_noise_ratio(truth[..., c], render[..., c], data_range=1.0) for c in range(3)]
    return {
        "psnr": float(peak_signal_noise_ratio(truth, render, data_range=1.0)),
        "psnr_channel_mean": float(np.mean(channels)),
        "ssim": scikit_ssim(framed(render), framed(truth)),
        "ssim_valid": scikit_ssim(render, truth),
        "ssim_reflect": scikit_ssim(reflected(render), reflected(truth)),
        "l1": float(np.abs(render - truth).mean()),
    }


def by_torchmetrics(render: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    x, y = as_tensor(render), as_tensor(truth)
    channels = [torchmetrics_psnr(x[:, c], y[:, c], data_range=1.0) for c in range(3)]
    return {
        "psnr": float(torchmetrics_psnr(x, y, data_range=1.0)),
        "psnr_channel_mean": float(torch.stack(channels).mean()),
        "ssim": torchmetrics_ssim(framed(render), framed(truth), inside=HALF_WINDOW),
        "ssim_valid": torchmetrics_ssim(render, truth, inside=HALF_WINDOW),
        "ssim_reflect": torchmetrics_ssim(render, truth),
        "l1": float(torch.nn.functional.l1_loss(x, y)),
    }


def check(run: Path, scene: Path | None) -> Iterator[Row]:
    """The rows of one run directory; `scene` instead of the folder that its config.toml names."""
    record = json.loads((run / "metrics.json").read_text())
    if scene is None:
        scene = Path(tomllib.loads((run / "config.toml").read_text())["scene"])
    views = record["views"]
    found: dict[str, list[tuple[float, float]]] = {}
    for view in views:
        render = np.asarray(Image.open(run / "renders" / render_name(view, views)), dtype=np.float64) / 255
        truth = ground_truth(scene, record, view, (render.shape[1], render.shape[0]))
        ours, theirs = by_scikit_image(render, truth), by_torchmetrics(render, truth)
        for name in ours:
            found.setdefault(name, []).append((ours[name], theirs[name]))
    for name, pairs in found.items():
        recorded = record["metrics"].get(name)
        if recorded is None or recorded["mean"] is None:
            continue
        differences = [abs(v - w) for v, pair in zip(recorded["per_view"], pairs, strict=True) for w in pair]
        means = [math.fsum(column) / len(pairs) for column in zip(*pairs, strict=True)]
        differences += [abs(recorded["mean"] - mean) for mean in means]
        yield Row(str(run), name, recorded["mean"], *means, max(differences))


def render_name(view: str, views: list[str]) -> str:
    """The file of a view's render: folders joined by __, the suffix kept where two views would share a name."""
    flat = [name.replace("/", "__") for name in views]
    stems = [name.rsplit(".", 1)[0] for name in flat]
    here = views.index(view)
    return f"{stems[here] if stems.count(stems[here]) == 1 else flat[here]}.png"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories, each with metrics.json and renders/")
    parser.add_argument("--scene", type=Path, help="the scene's folder  [default: what each run's config.toml names]")
    args = parser.parse_args()
    table = Table()
    table.add_column("run")
    table.add_column("metric")
    for heading in ("metrics.json", "scikit-image", "torchmetrics", "largest difference", "allowed"):
        table.add_column(heading, justify="right")
    rows = [row for run in args.runs for row in check(run, args.scene)]
    for row in rows:
        values = (f"{value:.6f}" for value in (row.recorded, row.scikit_image, row.torchmetrics))
        told = f"{row.largest_difference:.1e}" + ("" if row.agrees else " DIFFERS")
        table.add_row(row.run, row.metric, *values, told, f"{row.tolerance:.0e}")
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    return 0 if rows and all(row.agrees for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
