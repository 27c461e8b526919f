"""Run directories as `sw run` leaves them, made without training: real records, pictures that score what they say."""

import json
import math
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image
from sw_report.published_files import read_published

from splatwizard_core.plugins import PluginManager, hookimpl
from splatwizard_core.runs.record import Record

SIZE = (48, 32)  # width, height
PROTOCOL = {
    "dataset": "colmap", "images": "images", "resolution": -1, "split": "every8", "background": "black",
    "principal_point": "center", "quantize8": True, "masked": False, "composite8": False, "turned": False,
}  # fmt: skip
UNKNOWN = {
    "memory.peak_reserved_bytes": "a CPU has none", "train.breakdown_s": "not profiled", "geometry": "not asked for",
    "speed.spread": "measured once",
}  # fmt: skip


@hookimpl
def register_metrics(registry: Any) -> None:
    for name, label, position in (
        ("lpips_vgg_3dgs", "LPIPS (VGG, 3DGS)", 3), ("lpips_vgg", "LPIPS (VGG)", 4), ("lpips_alex", "LPIPS (Alex)", 5),
    ):  # fmt: skip
        registry.add(name, "nowhere:metric", summary="", direction="lower", label=label, digits=4, position=position)
    registry.add("psnr_unrounded", "nowhere:metric", summary="", direction="higher", label="PSNR, unrounded", unit="dB",
                 digits=2, diagnostic=True)  # fmt: skip
    registry.add("edge-psnr", "nowhere:metric", summary="", direction="higher", label="Edge PSNR", unit="dB", digits=2)
    registry.add("odd", "nowhere:metric", summary="", direction="lower", digits="many", position="first")


@hookimpl
def register_datasets(registry: Any) -> None:
    rooms = ["room", "counter", "kitchen", "bonsai"]
    registry.add("mipnerf360", "nowhere:family", summary="", title="Mip-NeRF 360",
                 scenes=["bicycle", "flowers", "garden", "stump", "treehill", *rooms])  # fmt: skip
    registry.add("tandt", "nowhere:family", summary="", title="Tanks & Temples", scenes=["train", "truck"])
    registry.add("dtu", "nowhere:family", summary="", title="DTU", scenes=["24", "37"], prefix="scan")
    registry.add("colmap", "nowhere:family", summary="")


@hookimpl
def register_methods(registry: Any) -> None:
    registry.add("hac-plus", "nowhere:method", title="HAC++", summary="")
    for name, rank, title in (("hac", 1, "HAC"), ("lightgaussian", 2, "LightGaussian"), ("3dgs", 3, "3DGS")):
        declared = {"published": "published_example:hac.toml"} if name == "hac" else {}
        registry.add(name, "nowhere:method", title=title, summary="", bd_anchor=rank, **declared)
    registry.add("another", "nowhere:method", summary="")


@hookimpl
def register_coders(registry: Any) -> None:
    registry.add("range", "nowhere:coder", summary="", codes="gaussians")
    registry.add("plain", "nowhere:coder", summary="", codes="gaussians", stores="float32")


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[PluginManager]:
    """The core, and beside it what the hooks above declare, whatever is installed where the tests run."""
    plugin = ModuleType("declaring_plugin")
    for hook in (register_metrics, register_datasets, register_methods, register_coders):
        setattr(plugin, hook.__name__, hook)
    monkeypatch.setitem(sys.modules, plugin.__name__, plugin)
    found = PluginManager(
        [EntryPoint("core", "splatwizard_core.builtin", "splatwizard"),
         EntryPoint("declaring", plugin.__name__, "splatwizard")]
    )  # fmt: skip
    assert not found.broken
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.setattr("sw_report.declared.load_plugins", lambda: found)
    monkeypatch.setattr("sw_report.published_files.load_plugins", lambda: found)
    read_published.cache_clear()
    yield found
    read_published.cache_clear()


def photograph(view: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """[H,W,3] uint8: a smooth picture, another for each view."""
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    return np.stack([200 * x, 200 * y, 40 + 20.0 * view + 0 * x], axis=2).astype(np.uint8)


def record_content(**changes: Any) -> dict[str, Any]:
    """A whole record of the schema of today."""
    found: dict[str, Any] = {
        "method": "toy", "method_version": 1, "distribution": "sw-toy 0.1", "preset": "paper", "rate": "r1",
        "config": {"method": "toy", "config": {"iterations": 300, "lr": {"means": 1e-3}}, "provenance":
                   {"iterations": "--set"}},
        "config_hash": "00", "dataset": "colmap", "scene": "garden",
        "protocol": {"id": "colmap/images/r-1/every8/black/pp-center/q8", **PROTOCOL},
        "train_views": 7, "test_views": 5, "views": [f"v{i}.png" for i in range(5)],
        "metrics": {}, "file": {"bytes": 1000, "sha256": "ab", "digest": "cd",
                                "sections": {"header": 100, "positions": 500, "color": 400}},
        "counts": {"num_gaussians": 1234}, "visible_gaussians": 600.0,
        "codec": {"encode_s": 0.1, "decode_s": 0.2, "decode_runs_s": [0.1, 0.2, 0.3], "first_decode_s": 0.3,
                  "jit_s": 0.01, "decode_spread": {"n": 3, "mean": 0.2, "std": 0.1, "min": 0.1, "max": 0.3},
                  "peak_decode_bytes": 1, "memory_kind": "rss"},
        "speed": {"fps": 12.5, "latency_ms_median": 80.0, "latency_ms_p95": 90.0, "prepare_s": 0.0, "frames": 5,
                  "rounds": 1, "views": 5, "warmup_frames": 10, "image_size": list(SIZE), "jit_s": 0.01,
                  "load_s": 0.3, "repeats": 1, "spread": None},
        "memory": {"kind": "rss", "model_bytes": 10, "peak_load_bytes": 20, "peak_render_bytes": 30,
                   "peak_reserved_bytes": None},
        "train": {"train_s": 60.0, "stages": [{"name": "toy", "seconds": 60.0}], "with_pretraining_s": 60.0,
                  "steps": 300, "peak_bytes": 5_000_000, "memory_kind": "rss", "breakdown_s": None,
                  "trained_in": "r1", "pictures_in": "host", "pretraining": {}},
        "phases": [
            {"phase": "train: toy", "provided_by": [
                {"kind": "stage", "name": "toy", "distribution": "sw-toy", "version": "0.1"},
                {"kind": "rasterizer", "name": "standard", "distribution": "sw-rasterizers", "version": "0.2"}]},
            {"phase": "encode", "provided_by": [
                {"kind": "method", "name": "toy", "distribution": "sw-toy", "version": "0.1"}]},
        ],
        "plan": [], "rasterizers": {"train": {"BACKWARD": "standard"}, "render": {"SPLIT_SH": "standard"}},
        "environment": {"python": "3.11", "device": "cpu", "cpu": "A Processor", "threads": 2, "gpu": None,
                        "packages": {"sw-toy": "0.1"}},
        "flags": ["rss"], "unknown": UNKNOWN, "date": "2026-01-01T00:00:00+00:00",
    }  # fmt: skip
    return {**found, **changes}


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """(...) -> a run directory.

    noise       standard deviation of the renders' error, 8-bit steps: what their PSNR comes from
    rate, method, scene, size, out  where and what it is
    keep        the parts that are there
    change      (record) -> None, before it is written
    """

    def make(
        rate: str = "r1", noise: float = 8.0, *, method: str = "toy", scene: str = "garden", size: int = 1000,
        views: int = 5, out: Path | None = None, pixels: tuple[int, int] = SIZE,
        keep: tuple[str, ...] = ("renders", "truth", "log"), change: Callable[[dict[str, Any]], None] | None = None,
    ) -> Path:  # fmt: skip
        directory = (out or tmp_path / "out") / scene / method / rate
        generator = np.random.default_rng(int(noise * 100) + views)
        psnr = []
        for folder in ("renders", "truth"):
            (directory / folder).mkdir(parents=True)
        for i in range(views):
            truth = photograph(i, pixels)
            error = generator.normal(0, noise * (1 + i / 10), truth.shape)
            render = np.clip(truth + error, 0, 255).astype(np.uint8)
            difference = render.astype(float) - truth
            psnr.append(10 * math.log10(255**2 / np.mean(difference**2)))
            for folder, picture in (("renders", render), ("truth", truth)):
                if folder in keep:
                    Image.fromarray(picture).save(directory / folder / f"v{i}.png")
        if "log" in keep:
            lines = [
                {"stage": 0, "step": n, "loss": 1 / n, "num_gaussians": 1000 + n, "lr": {}} for n in range(1, 301, 5)
            ]
            (directory / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        content = record_content(rate=rate, method=method, scene=scene, test_views=views)
        content["views"] = [f"v{i}.png" for i in range(views)]
        content["file"] = {**content["file"], "bytes": size, "sections": {"header": 100, "positions": size - 100}}
        content["train"] = {**content["train"], "trained_in": rate}
        content["metrics"] = {
            "psnr": {"mean": float(np.mean(psnr)), "per_view": psnr, "direction": "higher"},
            "ssim": {"mean": 1 - noise / 100, "per_view": [1 - noise / 100] * views, "direction": "higher"},
        }
        content = Record.model_validate(content).model_dump(mode="json")  # what follows may damage it
        if change is not None:
            change(content)
        (directory / "metrics.json").write_text(json.dumps(content))
        return directory

    return make


@pytest.fixture
def make_curve(make_run: Callable[..., Path]) -> Callable[..., list[Path]]:
    """(...) -> four run directories of one method: r1 to r4, larger and better; `saving` scales their bytes."""

    def make(method: str = "toy", saving: float = 1.0, **named: Any) -> list[Path]:
        sizes = (1000, 2000, 4000, 9000)
        return [
            make_run(f"r{i + 1}", 16 / (i + 1), method=method, size=int(size * saving), **named)
            for i, size in enumerate(sizes)
        ]

    return make
