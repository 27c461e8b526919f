"""`sw render --trajectory`: frames on a path, as pictures and as videos, and what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from sw_gaussians.ply import export_ply
from sw_view.drawing import Drawing

from splatwizard_core.api import GaussianModel, SceneOptions
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import load_plugins, load_scene

SCENE = "demo:tiny"


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty coloured blobs about the middle of the scene."""
    generator = torch.Generator().manual_seed(0)
    path = tmp_path_factory.mktemp("blobs") / "blobs.ply"
    means = 0.6 * torch.randn(40, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.4])
    model = GaussianModel.from_tensors(
        means, torch.randn(40, 1, 3, generator=generator), torch.zeros(40, 0, 3), torch.full((40,), 4.0),
        torch.full((40, 3), -1.8), torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
    )  # fmt: skip
    export_ply(model, path)
    return path


class FakeLibrary:
    """An encoder that keeps its frames, and writes their number; `videos`: name -> [n,H,W,3]."""

    def __init__(self) -> None:
        self.videos: dict[str, list[np.ndarray]] = {}
        self.rates: list[float] = []
        self.VideoFrame = SimpleNamespace(from_ndarray=lambda pixels, format: FakeFrame(pixels))

    def open(self, path: str, mode: str, *, format: str) -> FakeContainer:
        assert (mode, format) == ("w", "mp4")
        return FakeContainer(Path(path), self)


class FakeFrame:
    def __init__(self, pixels: np.ndarray) -> None:
        self.pixels = pixels.copy()

    def reformat(self, **_: Any) -> FakeFrame:
        return self


class FakeContainer:
    def __init__(self, path: Path, library: FakeLibrary) -> None:
        self.path, self.library = path, library
        self.codec_context = SimpleNamespace()

    def __enter__(self) -> FakeContainer:
        self.path.write_bytes(b"begun")
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def add_stream(self, encoder: str, rate: Any, options: dict[str, str]) -> FakeContainer:
        self.library.rates.append(float(rate))
        return self

    def encode(self, frame: FakeFrame | None) -> FakeFrame | None:
        return frame

    def mux(self, frame: FakeFrame | None) -> None:
        if frame is not None:
            assert frame.pixels.shape == (self.height, self.width, 3)  # type: ignore[attr-defined]
            name = self.path.name.removeprefix(".").partition(".mp4")[0]
            self.library.videos.setdefault(name, []).append(frame.pixels)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> FakeLibrary:
    fake = FakeLibrary()
    monkeypatch.setitem(sys.modules, "av", fake)
    return fake


def run(capsys: pytest.CaptureFixture[str], ply: Path, *arguments: object) -> dict[str, Any]:
    assert main(["render", str(ply), "--scene", SCENE, *map(str, arguments), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return facts


def refused(capsys: pytest.CaptureFixture[str], ply: Path, *arguments: object) -> str:
    assert main(["render", str(ply), "--scene", SCENE, *map(str, arguments)]) == 2
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return " ".join(told.err.split())


@pytest.mark.parametrize("path", ["orbit", "spiral", "cameras"])
def test_a_path_is_drawn_as_pictures(tmp_path: Path, capsys, ply: Path, path: str):
    facts = run(capsys, ply, "--trajectory", path, "--frames", 5, "--size", "40x31", "--out", tmp_path, "--depth")
    assert facts["files"] == [f"frame_{i:04d}.png" for i in range(5)]
    pictures = [np.asarray(Image.open(tmp_path / name)) for name in facts["files"]]
    assert {picture.shape for picture in pictures} == {(31, 40, 3)}
    assert all(picture.any() for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == 5
    assert (tmp_path / "depth_expected" / "frame_0004.npz").is_file()


def test_cameras_of_a_file_give_the_pictures_of_those_cameras(tmp_path: Path, capsys, ply: Path):
    cameras = [view.camera for view in load_scene(SCENE, SceneOptions(), load_plugins()).test]
    entries = [
        {"width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
         "position": c.center.double().tolist(), "rotation": c.R.T.double().tolist()}
        for c in cameras
    ]  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    run(capsys, ply, "--trajectory", tmp_path / "cameras.json", "--out", tmp_path / "file")
    views = run(capsys, ply, "--out", tmp_path / "views")["files"]
    for i, name in enumerate(views):
        ours = np.asarray(Image.open(tmp_path / "file" / f"frame_{i:04d}.png")).astype(int)
        assert abs(ours - np.asarray(Image.open(tmp_path / "views" / name))).max() <= 1  # R is rounded otherwise


def test_a_video_holds_the_frames_that_are_drawn_as_pictures(tmp_path: Path, capsys, ply: Path, library: FakeLibrary):
    arguments = ["--trajectory", "orbit", "--frames", 4, "--size", "41x30"]
    facts = run(capsys, ply, *arguments, "--video", tmp_path / "out.mp4", "--fps", 12.5, "--depth", "--normals",
                "--alpha")  # fmt: skip
    names = ["out", "out_depth_expected", "out_normals", "out_alpha"]
    assert facts["files"] == [str(tmp_path / f"{name}.mp4") for name in names]
    assert sorted(path.stem for path in tmp_path.iterdir()) == sorted(names)
    assert (facts["frames"], facts["fps"], library.rates) == (4, 12.5, [12.5] * 4)
    assert {len(frames) for frames in library.videos.values()} == {4}
    arguments[-1] = "40x30"  # a video has even sides
    run(capsys, ply, *arguments, "--out", tmp_path / "png")
    for i, frame in enumerate(library.videos["out"]):
        assert (frame == np.asarray(Image.open(tmp_path / "png" / f"frame_{i:04d}.png"))).all()


def test_the_colours_of_depth_mean_the_same_in_all_frames(tmp_path: Path, capsys, ply: Path, library: FakeLibrary):
    path = tmp_path / "cameras.json"
    camera = load_scene(SCENE, SceneOptions(), load_plugins()).test[0].camera
    forward = camera.R[2]
    entries = [
        {"width": 64, "height": 48, "fx": 60, "fy": 60, "position": (camera.center - back * forward).tolist(),
         "rotation": camera.R.T.tolist()}
        for back in (0.0, 3.0)
    ]  # fmt: skip
    path.write_text(json.dumps(entries))
    run(capsys, ply, "--trajectory", path, "--video", tmp_path / "out.mp4", "--depth")
    near, far = library.videos["out_depth_expected"]
    # Turbo runs from blue to red: what is 3 units farther away is redder.
    redness = [float((f[..., 0].astype(int) - f[..., 2])[f.any(axis=2)].mean()) for f in (near, far)]
    assert redness[1] > redness[0] + 50


def test_an_interrupt_leaves_no_video(tmp_path: Path, monkeypatch, ply: Path, library: FakeLibrary):
    (tmp_path / "out.mp4").write_bytes(b"the last one")
    drawn, render = [], Drawing.render

    def interrupted(self: Drawing, *arguments: Any) -> Any:
        drawn.append(arguments)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        return render(self, *arguments)

    monkeypatch.setattr(Drawing, "render", interrupted)
    status = main(["render", str(ply), "--scene", SCENE, "--trajectory", "orbit", "--video", str(tmp_path / "out.mp4"),
                   "--alpha"])  # fmt: skip
    assert status == 130
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]
    assert (tmp_path / "out.mp4").read_bytes() == b"the last one"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--video", "{}/o.mp4"], "--video, --frames and --size are for --trajectory: orbit, spiral, cameras or"),
        (["--frames", "3"], "are for --trajectory"),
        (["--trajectory", "orbit", "--fps", "3"], "--fps is for --video"),
        (["--trajectory", "orbit", "--video", "{}/o.mp4", "--fps", "1e-4"], "0.001<=x<=1000"),
        (["--trajectory", "orbti"], "'orbti' is none of orbit, spiral, cameras, and no file"),
        (["--trajectory", "orbit", "--size", "640"], "WIDTHxHEIGHT in pixels"),
        (["--trajectory", "orbit", "--size", "8x8"], "WIDTHxHEIGHT in pixels"),
        (["--trajectory", "orbit", "--video", "{}/o.avi"], "must end in one of .mp4, .mkv, .mov, .webm"),
        (["--trajectory", "orbit", "--video", "{}/no/o.mp4"], "there is no folder"),
        (["--trajectory", "orbit", "--video", "{}/o.mp4", "--depth", "expected", "--depth-png"], "leave out --video"),
        (["--trajectory", "{}/c.json"], "neither a list of cameras"),
        (["--trajectory", "{}/good.json", "--frames", "3"], "has a camera for every frame"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_told_in_a_line(
    tmp_path: Path, capsys, ply: Path, library: FakeLibrary, options: list[str], told: str
):
    (tmp_path / "c.json").write_text("{}")
    entry = {"width": 4, "height": 4, "fx": 4, "fy": 4, "position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    (tmp_path / "good.json").write_text(json.dumps([entry]))
    arguments = [option.format(tmp_path) for option in options]
    assert told in refused(capsys, ply, *arguments, "--out", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.json", "good.json"]


def test_without_the_library_the_extra_is_named(tmp_path: Path, capsys, monkeypatch, ply: Path):
    monkeypatch.setitem(sys.modules, "av", None)
    said = refused(capsys, ply, "--trajectory", "orbit", "--video", tmp_path / "o.mp4")
    assert "--video needs the package av: pip install 'sw-view[video]'" in said


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_real_video_shows_the_pictures(tmp_path: Path, capsys, ply: Path, suffix: str):
    av = pytest.importorskip("av", reason="videos are encoded by the package av")
    video = tmp_path / f"out{suffix}"
    arguments = ["--trajectory", "orbit", "--frames", 6, "--size", "96x64"]
    run(capsys, ply, *arguments, "--video", video, "--fps", 24)
    run(capsys, ply, *arguments, "--out", tmp_path)
    with av.open(str(video)) as container:
        assert float(container.streams.video[0].average_rate) == 24
        frames = list(container.decode(video=0))
    assert len(frames) == 6
    assert {int(frame.colorspace) for frame in frames} == {1}  # BT.709, and it says so
    for i, frame in enumerate(frames):
        picture = np.asarray(Image.open(tmp_path / f"frame_{i:04d}.png")).astype(float)
        error = ((frame.to_ndarray(format="rgb24") - picture) ** 2).mean()
        assert 10 * np.log10(255**2 / error) > 28  # half the colour resolution, and a loss that is hard to see
