"""`sw bench --protocol mpeg-gsc`: a model through codecs, end to end, and the views it is seen from."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from sw_bench.gsc import TITLE, coding, protocol
from sw_bench.gsc.coding import CodecFailedError
from sw_bench.gsc.frames import frame_files, joined
from sw_bench.gsc.protocol import sequence_names
from sw_bench.gsc.tables import PARTS
from sw_bench.gsc.views import Asked, camera_hash, size_of, views_of
from sw_gaussians.ply import export_ply
from sw_interchange.ply_cameras import PlyCamera, ply_camera_comments

import splatwizard_core.runs.fresh
from splatwizard_core.api import Camera, CapabilityError, GaussianModel, UserInputError
from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins

SIZE = {"width": 40, "height": 30, "fx": 36.0, "fy": 36.0}
AHEAD = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
AWAY = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]


def model_of(n: int = 150, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    return GaussianModel.from_tensors(
        0.5 * torch.randn(n, 3, generator=g), 0.4 * torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, 3, 3, generator=g), 2 + torch.randn(n, generator=g),
        0.3 * torch.randn(n, 3, generator=g) - 2, torch.randn(n, 4, generator=g),
    )  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A model, and cameras: two that see it, one that looks away."""
    folder = tmp_path_factory.mktemp("gsc")
    export_ply(model_of(), folder / "chair.ply")
    places = [([0, 0, -3], AHEAD), ([0.5, 0, -3], AHEAD), ([0, 0, -3], AWAY)]
    cameras = [{**SIZE, "position": position, "rotation": rotation} for position, rotation in places]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return folder / "chair.ply", folder / "cameras.json"


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Codecs run without a process of their own, which takes seconds; the words of each command are noted."""
    done: list[list[str]] = []

    def run(words: list[str], folder: Path) -> tuple[dict[str, Any], float]:
        done.append(words)
        said, here = io.StringIO(), Path.cwd()
        os.chdir(folder)
        try:
            with contextlib.redirect_stdout(said):
                assert main([*words, "--json"]) == 0
        finally:
            os.chdir(here)
        return json.loads(said.getvalue()), 100.0

    monkeypatch.setattr(coding, "run", run)
    return done


def bench(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["bench", "--protocol", "mpeg-gsc", *map(str, words), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return facts


def test_a_model_through_codecs_with_and_without_a_dial(tmp_path: Path, capsys, files, in_this_process):
    model, cameras = files
    words = (model, "--cameras", cameras, "--method", "gsc-quant,3dgs,splat", "--out", tmp_path)
    facts = bench(capsys, *words)
    assert facts["protocol"] == TITLE
    (source,) = facts["sources"]
    assert (source["views"], source["empty_views"]) == (["000", "001"], ["002"])
    assert re.fullmatch(r"gsc-[0-9a-f]{8}/json:[0-9a-f]{8}/40x30/src/black/[\w.+-]+-a99/q8", source["protocol"])
    rows = {(row["codec"], row["rate"]): row for row in facts["rows"]}
    assert [rate for codec, rate in rows if codec == "gsc-quant"] == ["r1", "r2", "r3", "r4", "r5"]
    assert [rate for codec, rate in rows if codec == "splat"] == ["r0"]
    dial = [rows["gsc-quant", f"r{i}"] for i in range(1, 6)]
    assert [row["bytes"] for row in dial] == sorted(row["bytes"] for row in dial)
    assert [row["psnr_rgb"] for row in dial] == sorted(row["psnr_rgb"] for row in dial)
    for row in dial:
        assert sum(row[f"bytes_{part}"] for part in ("position", "sh0", "sh1", "sh2", "sh3", "rotation", "scaling",
                                                     "opacity", "metadata")) == row["bytes"]  # fmt: skip
        assert [view["view"] for view in row["per_view"]] == ["000", "001"]
    assert rows["splat", "r0"]["bytes_position"] is None
    assert rows["splat", "r0"]["flags"] == "sh-dropped"
    # r6 of 3dgs is exact: its views have no PSNR, so BD-rates are of pooled errors, without that point.
    assert (rows["3dgs", "r6"]["psnr_rgb"], rows["3dgs", "r6"]["infinite_views"]) == (None, 2)
    assert rows["3dgs", "r6"]["flags"] == "infinite"
    (of_scene, mean) = facts["bd"]
    assert (of_scene["codec"], of_scene["sequence"], mean["sequence"]) == ("3dgs", "chair", "mean")
    assert of_scene["note"].startswith("pooled PSNR; psnr_rgb: 1 points of 3dgs without a value")
    table = list(csv.DictReader((tmp_path / "mpeg-gsc" / "gsc.csv").open()))
    assert len(table) == len(rows) == 12
    assert (tmp_path / "mpeg-gsc" / "gsc_bd.csv").read_text().count("\n") == 3
    assert len(list((tmp_path / "mpeg-gsc" / "chair" / "reference").glob("*.png"))) == 2
    # What is finished is not done again.
    count = len(in_this_process)
    assert bench(capsys, *words)["rows"] == facts["rows"]
    assert len(in_this_process) == count


def test_photographs_are_a_block_of_their_own(tmp_path: Path, capsys, files, in_this_process):
    facts = bench(capsys, files[0], "--cameras", photographs(tmp_path), "--method", "splat", "-o", "anchor=splat",
                  "--out", tmp_path)  # fmt: skip
    (row,) = facts["rows"]
    photos = row["photos"]
    assert photos["protocol"] == row["protocol"].replace("/src/", "/photos/")
    assert photos["psnr"]["drop"] == pytest.approx(photos["psnr"]["source"] - photos["psnr"]["decoded"])
    assert photos["psnr"]["source"] < row["psnr_rgb"]  # nobody trained on these pictures
    assert 0 < photos["ssim"]["decoded"] < 1


def photographs(folder: Path) -> Path:
    """A Blender scene of white pictures, seen from where the model is in sight."""
    from PIL import Image

    for part, count in (("train", 1), ("test", 2)):
        (folder / "white" / part).mkdir(parents=True)
        frames = []
        for i in range(count):
            matrix = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
            frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": matrix})
            Image.new("RGB", (40, 30), (255, 255, 255)).save(folder / "white" / part / f"r_{i}.png")
        text = json.dumps({"camera_angle_x": 0.9, "frames": frames})
        (folder / "white" / f"transforms_{part}.json").write_text(text)
    return folder / "white"


def test_frames_are_one_sequence_seen_from_one_place(tmp_path: Path, capsys, files, in_this_process):
    for i in (9, 10):
        export_ply(model_of(seed=i, n=100 + i), tmp_path / f"dance{i:03d}.ply")
    words = ("--frames", tmp_path / "dance%03d.ply", "--cameras", files[1], "--method", "splat", "-o", "anchor=splat")
    facts = bench(capsys, *words, "--out", tmp_path / "out")
    ((source,), (row,)) = facts["sources"], facts["rows"]
    alone = [bench(capsys, tmp_path / f"dance{i:03d}.ply", *words[2:], "--out", tmp_path / f"{i}")["rows"][0]
             for i in (9, 10)]  # fmt: skip
    assert [each["file"] for each in source["frames"]] == ["dance009.ply", "dance010.ply"]
    assert (row["sequence"], row["frames"], row["splats_source"]) == ("dance", 2, 219)
    assert row["bytes"] == alone[0]["bytes"] + alone[1]["bytes"]
    assert row["kbps"] == pytest.approx(8 * row["bytes"] * 30 / 2000)
    assert row["psnr_rgb"] == pytest.approx((alone[0]["psnr_rgb"] + alone[1]["psnr_rgb"]) / 2)
    assert [view["frame"] for view in row["per_view"]] == [0, 0, 1, 1]
    of_one = alone[0]["protocol"].partition("/")
    assert row["protocol"].partition("/")[2] == of_one[2]
    assert row["protocol"].partition("/")[0] != of_one[0]


def test_frames_are_numbered_without_a_gap(tmp_path: Path):
    for name in ("f0008.ply", "f0010.ply", "f9.ply", "f0009.txt"):
        (tmp_path / name).touch()
    with pytest.raises(UserInputError, match="frame 9 is missing"):
        frame_files(str(tmp_path / "f%04d.ply"))
    (tmp_path / "f0009.ply").touch()
    assert [file.name for file in frame_files(str(tmp_path / "f%04d.ply"))] == ["f0008.ply", "f0009.ply", "f0010.ply"]
    for pattern, told in (("f%04d%d.ply", "give one %d"), ("g%d.ply", "no such file")):
        with pytest.raises(UserInputError, match=told):
            frame_files(str(tmp_path / pattern))


def test_a_sequence_is_as_good_as_all_its_frames():
    view = {"psnr_rgb": 30.0, "psnr_yuv": 31.0, "ssim_yuv": 0.9, "om_psnr_rgb": None, "om_ssim_yuv": None,
            "occupancy": 50.0, "mse_rgb": 1.0, "mse_yuv": 1.0}  # fmt: skip
    row = {"codec": "c", "rate": "r1", "splats_source": 4, "splats_decoded": 4, "bytes": 10, "flags": "", "views": 1,
           "enc_s": 1.0, "dec_s": 2.0, "rss_enc_mb": 5.0, "rss_dec_mb": 6.0, "per_view": [view],
           **{f"bytes_{part}": None for part in PARTS}}  # fmt: skip
    rows = [row | {"protocol": "gsc-aa/x/range-auto:position"}, row | {"protocol": "gsc-bb/x/range-auto:scale",
            "rss_enc_mb": 9.0, "flags": "sh-dropped"}]  # fmt: skip
    found = joined("s", rows)
    assert (found["bytes"], found["enc_s"], found["rss_enc_mb"], found["flags"]) == (20, 2.0, 9.0, "sh-dropped")
    assert (found["bits_per_splat"], found["views"], found["bytes_sh0"]) == (20.0, 1, None)
    assert re.fullmatch(r"gsc-[0-9a-f]{8}/x/range-auto:position\+scale", found["protocol"])
    lost = joined("s", [rows[0], rows[1] | {"bytes": None, "flags": "failed", "reason": "no memory"}])
    assert (lost["bytes"], lost["flags"], lost["reason"]) == (None, "failed", "frame 2 of 2: no memory")


def test_an_opacity_limit_that_no_rasterizer_here_has_is_refused(tmp_path: Path, capsys, files):
    words = ["bench", "--protocol", "mpeg-gsc", str(files[0]), "--cameras", str(files[1]), "--device", "cpu"]
    assert main([*words, "-o", "alpha_max=0.999", "--out", str(tmp_path)]) == 2
    assert "opacity limit of 0.999" in capsys.readouterr().err


def test_a_codec_that_fails_has_a_row_without_values(tmp_path: Path, capsys, files, in_this_process, monkeypatch):
    works = coding.run

    def run(words: list[str], folder: Path) -> tuple[dict[str, Any], float | None]:
        if "splat" in words:
            raise CodecFailedError("sw encode: out of luck")
        return works(words, folder)

    monkeypatch.setattr(coding, "run", run)
    facts = bench(capsys, files[0], "--cameras", files[1], "--method", "splat,compressed-ply", "-o",
                  "anchor=compressed-ply", "--out", tmp_path)  # fmt: skip
    rows = {row["codec"]: row for row in facts["rows"]}
    assert (rows["splat"]["bytes"], rows["splat"]["flags"]) == (None, "failed")
    assert rows["splat"]["reason"] == "sw encode: out of luck"
    assert rows["compressed-ply"]["bytes"] > 0


def test_a_codec_whose_program_is_not_here_is_left_out_and_named(monkeypatch, capsys):
    monkeypatch.delenv("SPLATWIZARD_TMC3", raising=False)
    session = types.SimpleNamespace(plugins=load_plugins())
    found = {entry.name for entry in protocol.codecs_of(protocol.Plan([], Path()), session)}
    assert {"gsc-quant", "3dgs", "spz"} <= found
    assert "tmc13" not in found
    assert "tmc13 is left out: not available: tmc13 needs MPEG's program tmc3" in capsys.readouterr().err
    with pytest.raises(CapabilityError, match="SPLATWIZARD_TMC3"):
        protocol.codecs_of(protocol.Plan([], Path(), codecs=["tmc13"]), session)
    monkeypatch.setenv("SPLATWIZARD_TMC3", sys.executable)  # any program
    assert "tmc13" in {entry.name for entry in protocol.codecs_of(protocol.Plan([], Path()), session)}


def test_a_process_that_fails_tells_its_last_line(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(coding, "subprocess", splatwizard_core.runs.fresh.subprocess)
    with pytest.raises(CodecFailedError, match=r"sw info: .*nothing\.swz: there is no such file"):
        coding.run(["info", "nothing.swz"], tmp_path)


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the system does not tell a process's size")
def test_a_process_is_not_charged_with_the_size_of_its_parent():
    ballast = bytearray(200_000_000)
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", "held = bytearray(40_000_000); import time; time.sleep(0.2)"]
    )
    peak = coding._peak_of(process)
    assert process.returncode == 0
    assert peak is not None
    assert 40 < peak < 100 < len(ballast) / 1e6


@pytest.mark.parametrize(("words", "told"), [
    ([], "give one or more trained models"),
    (["{model}", "--scene", "demo"], "--scene is of no use"),
    (["{model}", "-o", "path=sideways"], "give one of auto, orbit16, inside16"),
    (["{model}", "-o", "paths=1"], "with --protocol mpeg-gsc give anchor=..."),
    (["{model}", "--size", "12"], "give WIDTHxHEIGHT"),
    (["{model}", "--method", "hac"], "hac has to train"),
    (["{model}", "--cameras", "{cameras}", "--views", "7"], "there is no view '7' among 3"),
    (["{model}", "--cameras", "{cameras}", "--views", "002"], "no view shows more than 1 %"),
    (["{folder}/nothing.ply"], "there is no such file"),
    (["{model}", "{model}"], "two of the files have one name"),
])  # fmt: skip
def test_wrong_input_is_told_in_a_line(tmp_path: Path, capsys, files, words: list[str], told: str):
    given = [word.format(model=files[0], cameras=files[1], folder=tmp_path) for word in words]
    assert main(["bench", "--protocol", "mpeg-gsc", *given, "--out", str(tmp_path)]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_options_of_the_protocol_are_of_no_use_without_it(capsys):
    assert main(["bench", "--views", "all"]) == 2
    assert "--views is for --protocol mpeg-gsc" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"), [("empty", "holds no Gaussian"), ("nan", "1 Gaussians hold values that are not finite")]
)
def test_a_model_that_is_none_is_refused(tmp_path: Path, capsys, change: str, told: str):
    model = model_of(0 if change == "empty" else 5)
    if change == "nan":
        with torch.no_grad():
            model.means[2, 1] = torch.nan
    export_ply(model, tmp_path / "bad.ply")
    assert main(["bench", "--protocol", "mpeg-gsc", str(tmp_path / "bad.ply"), "--out", str(tmp_path)]) == 2
    assert told in capsys.readouterr().err


def test_the_hash_of_cameras_is_that_of_their_rows():
    eye, at, up = torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    a = Camera.look_at(eye, at, up, width=40, height=30, fov_x=0.9)
    b = Camera.look_at(eye + 0.5, at, up, width=40, height=30, fov_x=0.9)
    assert re.fullmatch("[0-9a-f]{8}", camera_hash([a]))
    assert len({camera_hash([a, b]), camera_hash([b, a]), camera_hash([a]), camera_hash([a.resized(80, 60)])}) == 4
    negative = Camera(
        40, 30, a.fx, a.fy, 20, 15, torch.where(a.R == 0, -0.0, a.R), torch.where(a.tau == 0, -0.0, a.tau)
    )
    assert camera_hash([negative]) == camera_hash([a])


def test_cameras_of_comments_are_turned_as_the_user_says(tmp_path: Path):
    half = 0.5**0.5
    row = PlyCamera(1, 1, (1.0, 2.0, 3.0), (half, half, 0.0, 0.0), 36.0, 37.0, "one view")  # 90 degrees about x
    path = tmp_path / "with.ply"
    lines = ["ply", *(f"comment {each}" for each in ply_camera_comments([row])), "end_header", ""]
    path.write_bytes("\n".join(lines).encode())
    with pytest.raises(UserInputError, match="give --size"):
        views_of(path, model_of(), Asked(), load_plugins())
    found = views_of(path, model_of(), Asked(size=(40, 30)), load_plugins())
    (camera,) = found.cameras
    assert (found.kind, found.names, camera.fx, camera.fy, camera.cx) == ("ply", ["one view"], 36.0, 37.0, 20.0)
    torch.testing.assert_close(camera.center, torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(camera.R, torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), atol=1e-6, rtol=0)
    (other,) = views_of(path, model_of(), Asked(size=(40, 30), quaternion="c2w"), load_plugins()).cameras
    torch.testing.assert_close(other.R, camera.R.T)
    torch.testing.assert_close(other.center, camera.center)


def test_generated_cameras_stand_around_an_object_and_in_a_room(tmp_path: Path):
    pytest.importorskip("sw_gaussians.ring_cameras")
    path = tmp_path / "model.ply"
    export_ply(model_of(), path)
    found = views_of(path, model_of(), Asked(size=(40, 30)), load_plugins())
    assert (found.kind, len(found.cameras)) == ("orbit16", 16)
    g = torch.Generator().manual_seed(3)
    shell = model_of(2000)
    with torch.no_grad():
        shell.means.copy_(5 * torch.nn.functional.normalize(torch.randn(2000, 3, generator=g), dim=1))
    inside = views_of(path, shell, Asked(size=(40, 30)), load_plugins())
    assert inside.kind == "inside16"
    assert views_of(path, shell, Asked(size=(40, 30), path="orbit16"), load_plugins()).kind == "orbit16"
    assert inside.label == f"inside16:{camera_hash(inside.cameras)}"


def test_files_of_one_name_are_told_apart_by_their_folders():
    assert sequence_names([Path("a/x.ply"), Path("b/y.ply")]) == ["x", "y"]
    assert sequence_names([Path("/a/x.ply"), Path("/b/x.compressed.ply")]) == ["a-x", "b-x"]
    assert size_of("1280x720") == (1280, 720)
    assert protocol.ONE_RATE == "r0"
