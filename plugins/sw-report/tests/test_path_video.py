"""Models of vision of a path: what is written for `ffmpeg`, what it says, and what to do where something is missing."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from sw_report import path_video
from sw_report.compare import VIDEO_METRICS
from sw_report.path_video import PathVideo

from splatwizard_core.api import CapabilityError
from splatwizard_core.plugins import load_plugins

FAKE = """#!{python}
import json, pathlib, sys
if "-filters" in sys.argv:
    print(" .. libvmaf           VV->V      Calculate the VMAF between two video streams.")
    sys.exit()
inputs = [sys.argv[i + 1] for i, word in enumerate(sys.argv) if word == "-i"]
graph = sys.argv[sys.argv.index("-lavfi") + 1]
log = graph.rpartition("log_path=")[2]
if pathlib.Path(inputs[0]).read_bytes()[:3] == b"\\xff\\xff\\xff":
    sys.exit("no such model")
bytes_of = [sum(pathlib.Path(name).read_bytes()) for name in inputs]
said = {{"version": "9", "pooled_metrics": {{"vmaf": {{"mean": bytes_of[0] - bytes_of[1]}}}}}}
pathlib.Path(log).write_text(json.dumps(said))
"""


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program that gives the difference of the sums of the two videos as VMAF, B's less A's."""
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(FAKE.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    return program


def measured(names: tuple[str, ...], a: float, b: float, frames: int = 2) -> dict:
    with PathVideo(names, load_plugins()) as video:
        for _ in range(frames):
            video.add(torch.full((3, 4, 5), a / 255), torch.full((3, 4, 5), b / 255))
        return video.result()


def test_ffmpeg_gets_b_first_and_its_value_and_version_are_kept(ffmpeg: Path):
    found = measured(("vmaf",), 10, 12)
    assert found["vmaf"] == 2 * 3 * 4 * 5 * 2
    assert found["made_with"]["vmaf"].startswith("libvmaf 9, its default model")


def test_what_ffmpeg_says_is_told(ffmpeg: Path):
    found = measured(("vmaf",), 10, 255)
    assert (found["vmaf"], found["not_available"]["vmaf"]) == (None, "libvmaf failed: no such model")


def test_what_is_missing_is_told_with_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("PATH", str(tmp_path))

    monkeypatch.setattr(type(load_plugins().metrics.load("cvvdp")), "version", lambda self: None)
    found = measured(("cvvdp", "vmaf"), 1, 2)
    assert (found["cvvdp"], found["vmaf"]) == (None, None)
    assert found["not_available"]["cvvdp"] == "package-missing: pip install 'sw-metrics[cvvdp]'"
    assert "ffmpeg with libvmaf" in found["not_available"]["vmaf"]


def test_the_command_offers_the_metrics_that_there_are():
    assert set(VIDEO_METRICS) == set(path_video.METRICS)


def test_frames_are_of_one_size():
    with PathVideo(("vmaf",), load_plugins()) as video:
        video.add(torch.zeros(3, 4, 5), torch.zeros(3, 4, 5))
        with pytest.raises(CapabilityError, match="one size"):
            video.add(torch.zeros(3, 4, 6), torch.zeros(3, 4, 6))


def libvmaf() -> bool:
    program = shutil.which("ffmpeg")
    return program is not None and b"libvmaf" in subprocess.run([program, "-filters"], capture_output=True).stdout


def moving(noise: float) -> dict:
    """Of a picture that moves, and of it with noise."""
    g = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 8, 8, generator=g)
    base = torch.nn.functional.interpolate(coarse, size=(96, 130), mode="bicubic")[0].clamp(0, 1)
    with PathVideo(("cvvdp", "vmaf"), load_plugins()) as video:
        for t in range(4):
            frame = torch.roll(base, t, 2)
            video.add(frame, frame + noise * torch.randn(frame.shape, generator=g))
        return video.result()


@pytest.mark.skipif(not libvmaf(), reason="no ffmpeg with libvmaf is installed")
def test_vmaf_falls_with_noise():
    assert moving(0)["vmaf"] > 95 > moving(0.1)["vmaf"] + 10


@pytest.mark.skipif(importlib.util.find_spec("pycvvdp") is None, reason="cvvdp is an extra of sw-metrics")
def test_cvvdp_of_equal_videos_is_ten_and_falls_with_noise():
    assert moving(0)["cvvdp"] == pytest.approx(10, abs=1e-3)
    assert moving(0.1)["cvvdp"] < 9
