"""Models of vision of a path as a video: ColorVideoVDP by the package `cvvdp`, VMAF by an `ffmpeg` that has libvmaf.

Both compare B with A, frames rounded to 8 bit at 30 a second. They are optional, slow, and diagnostic: studies of
splats disagree about which measures go with opinions. Source: specification of the protocols, perceptual metrics.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

from splatwizard_core.api import CapabilityError, MetricSetup
from splatwizard_core.tooling import PluginManager

FPS = 30
LIMITED = "scale=out_color_matrix=bt709:out_range=limited,format=yuv420p"
NO_CVVDP = "package-missing: pip install 'sw-metrics[cvvdp]'"
NO_VMAF = "program-missing: put an ffmpeg with libvmaf on the PATH (`ffmpeg -filters` lists it)"


@dataclass
class PathVideo:
    """Takes the frames of A and B while they come, into files of a temporary folder; then measures both videos.

    names       of the metrics that are asked for, out of METRICS
    settings    of metrics, by group: `metrics.cvvdp.display`
    size        width and height of the frames
    """

    names: tuple[str, ...]
    plugins: PluginManager
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    size: tuple[int, int] = (0, 0)
    frames: int = 0
    _folder: tempfile.TemporaryDirectory[str] = field(
        default_factory=lambda: tempfile.TemporaryDirectory(prefix="sw-path-")
    )
    _files: list[IO[bytes]] = field(default_factory=list)

    def __enter__(self) -> PathVideo:
        self._files = [path.open("wb") for path in self.videos]
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files:
            file.close()
        self._folder.cleanup()

    @property
    def videos(self) -> list[Path]:
        """Files of A and B: red, green, blue of 8 bits, pixel after pixel, frame after frame."""
        return [Path(self._folder.name) / name for name in ("a.rgb", "b.rgb")]

    def add(self, reference: Tensor, render: Tensor) -> None:
        """Take the next frame of A and of B, [3,H,W] in 0..1. Raises CapabilityError for one of another size."""
        size = (int(reference.shape[2]), int(reference.shape[1]))
        if self.frames and self.size != size:
            raise CapabilityError("a video has frames of one size: the cameras of --path differ in width or height")
        self.size, self.frames = size, self.frames + 1
        for file, frame in zip(self._files, (reference, render), strict=True):
            file.write(
                torch.round(frame.clamp(0, 1) * 255).byte().permute(1, 2, 0).contiguous().cpu().numpy().tobytes()
            )

    def result(self) -> dict[str, Any]:
        """Return the value of each metric, or None; `not_available` says why, `made_with` what it depends on."""
        for file in self._files:
            file.flush()
        found: dict[str, Any] = {"made_with": {}, "not_available": {}}
        for name in self.names:
            try:
                found[name], found["made_with"][name] = METRICS[name](self)
            except CapabilityError as error:
                found[name] = None
                found["not_available"][name] = str(error)
        return found


def cvvdp(path: PathVideo) -> tuple[float, str]:
    """ColorVideoVDP in JOD, 10 where no difference is visible; and the version, display and rate.

    Raises CapabilityError without the package.
    """
    if "cvvdp" not in path.plugins.metrics:
        raise CapabilityError(NO_CVVDP, missing=["cvvdp"])
    target: Any = path.plugins.metrics.load("cvvdp")
    reference, test = (
        torch.frombuffer(bytearray(file.read_bytes()), dtype=torch.uint8)
        .view(path.frames, path.size[1], path.size[0], 3).permute(3, 0, 1, 2).float() / 255 for file in path.videos
    )  # fmt: skip
    value, made = target.of_video(MetricSetup(torch.device("cpu"), path.settings), test, reference, fps=FPS)
    return value, ", ".join(f"{name} {each}" for name, each in made.items())


def vmaf(path: PathVideo) -> tuple[float, str]:
    """VMAF of libvmaf's default model, the mean over frames in 0..100; and the version.

    Raises CapabilityError without an ffmpeg that has libvmaf, or where it fails.
    """
    program = shutil.which("ffmpeg")
    if program is None or b" libvmaf " not in _said(program, "-hide_banner", "-filters"):
        raise CapabilityError(NO_VMAF, missing=["ffmpeg"])
    reference, test = path.videos
    log = reference.with_name("vmaf.json")
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{path.size[0]}x{path.size[1]}", "-r", str(FPS)]
    graph = f"[0:v]{LIMITED}[test];[1:v]{LIMITED}[true];[test][true]libvmaf=log_fmt=json:log_path={log.name}"
    words = [*raw, "-i", test.name, *raw, "-i", reference.name, "-lavfi", graph, "-f", "null", "-"]
    told = _said(program, "-hide_banner", "-nostdin", "-loglevel", "error", *words, folder=log.parent)
    try:
        found = json.loads(log.read_bytes())
        value = float(found["pooled_metrics"]["vmaf"]["mean"])
    except (OSError, ValueError, LookupError, TypeError):
        last = (told.decode(errors="replace").strip().splitlines() or ["it says nothing"])[-1][:200]
        raise CapabilityError(f"libvmaf failed: {last}", missing=["ffmpeg"]) from None
    if not math.isfinite(value):
        raise CapabilityError("libvmaf failed: its value is not finite", missing=["ffmpeg"])
    return value, f"libvmaf {found.get('version', 'of unknown version')}, its default model, BT.709 limited yuv420p"


def _said(program: str, *words: str, folder: Path | None = None) -> bytes:
    """Both outputs of a program."""
    done = subprocess.run(
        [program, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder,
        check=False,
    )  # fmt: skip
    return done.stdout


METRICS = {"cvvdp": cvvdp, "vmaf": vmaf}
