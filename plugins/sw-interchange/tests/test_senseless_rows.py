"""Rows that mean nothing, in any format and by any command; limits of a format that are told before it is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from interchange_files import random_scene
from sw_interchange import decode, encode, read, write

from splatwizard_core.cli.main import main
from splatwizard_core.errors import BitstreamError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.decode import open_model, read_gaussians
from splatwizard_core.runs.encode import encode as encode_model
from splatwizard_core.runs.pretrained import make_method

N, BAD = 40, 3


def spoilt_scene():
    scene = random_scene(N, 0)
    scene.means[0, 1] = np.nan
    scene.log_scales[1, 0] = np.inf
    scene.quats[2] = 0
    return scene


def spoilt_splat(path: Path) -> None:
    rows = bytearray(encode(random_scene(N, 0), "splat", order="given")[0])
    rows[4:8] = np.float32(np.nan).tobytes()
    rows[32 + 12 : 32 + 16] = np.float32(np.inf).tobytes()
    rows[64 + 28 : 64 + 32] = bytes([128] * 4)
    path.write_bytes(rows)


def spoilt_glb(path: Path) -> None:
    scene = random_scene(N, 0)
    data = bytearray(encode(scene, "gltf")[0])
    for value, bad in ((scene.means[0, 1], np.nan), (scene.means[1, 1], np.inf)):
        places = [bytes(data).find(np.float32(sign * value).tobytes(), 20) for sign in (1, -1)]  # axes are turned
        at = max(places)
        data[at : at + 4] = np.float32(bad).tobytes()
    path.write_bytes(data)


def spoilt_ply(path: Path) -> None:
    scene = spoilt_scene()
    with path.open("wb") as file:
        file.write(encode(scene, "ply")[0])


SPOIL = {".ply": (spoilt_ply, 3), ".splat": (spoilt_splat, 3), ".glb": (spoilt_glb, 2)}


@pytest.fixture(params=SPOIL)
def spoilt(request, tmp_path):
    """(a file, how many of its rows mean nothing)"""
    make, count = SPOIL[request.param]
    path = tmp_path / f"bad{request.param}"
    make(path)
    return path, count


COMMANDS = {
    "export": ["export", "FILE", "OUT.ply"],
    "export to spz": ["export", "FILE", "OUT.spz"],
    "encode": ["encode", "FILE", "--method", "3dgs", "--out", "OUT.swz"],
    "eval": ["eval", "FILE", "--scene", "demo:tiny", "--no-speed", "--metrics", "l1", "--quiet"],
    "info": ["info", "FILE"],
    "compare": ["compare", "FILE", "FILE", "--scene", "demo:tiny"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_the_same_line(spoilt, tmp_path, command, caplog):
    path, count = spoilt
    words = [word.replace("FILE", str(path)).replace("OUT", str(tmp_path / "out")) for word in COMMANDS[command]]
    assert main(words) == 0
    assert f"{path.name}: {count} Gaussians mean nothing and were left out: " in caplog.text


def test_what_is_written_has_the_rows_that_are_left(spoilt, tmp_path):
    path, count = spoilt
    for name in ("out.ply", "out.swz", "out.sog"):
        command = (
            ["encode", str(path), "--method", "3dgs", "--rate", "r6", "--out"]
            if name == "out.swz"
            else ["export", str(path)]
        )
        assert main([*command, str(tmp_path / name)]) == 0
        assert main(["export", str(tmp_path / name), str(tmp_path / "back.ply")]) == 0
        assert read(tmp_path / "back.ply").num_gaussians == N - count


def test_info_counts_them(spoilt, capsys):
    path, count = spoilt
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["not_finite"] + facts["zero_rotation"] == count
    assert facts["num_gaussians"] == N - count


def test_rows_of_an_encoded_file_are_left_out_too(tmp_path, caplog):
    write(random_scene(N, 0), tmp_path / "good.ply")
    plugins, file = load_plugins(), tmp_path / "a.swz"
    model = read_gaussians(tmp_path / "good.ply", plugins).requires_grad_(False)
    model.means[3], model.quats[7] = torch.nan, 0
    method = make_method(plugins, resolve(plugins.methods.load("3dgs"), rate="r6", plugins=plugins))
    encode_model(method, model, {}, file)
    opened, _ = open_model(file, plugins, torch.device("cpu"))
    assert isinstance(opened, GaussianModel)
    assert opened.num_rows == N - 2
    assert "a.swz: 2 Gaussians mean nothing and were left out: 1 hold" in caplog.text


def test_an_outlier_that_ruins_a_chunk_is_told_before_the_file_is_written(tmp_path, caplog):
    scene = random_scene(300, 0)
    scene.log_scales[:] = np.log(0.02)
    quiet = encode(scene, "compressed-ply")[1]
    assert not quiet.warnings
    scene.means[1] = (5e4, 1, 1)
    seen = []
    write(
        scene,
        tmp_path / "a.compressed.ply",
        before=lambda report: seen.append((tmp_path.joinpath("a.compressed.ply").exists(), report.warnings)),
    )
    ((was_there, warnings),) = seen
    assert not was_there
    assert any("coordinates of" in line and "units" in line for line in warnings)


def test_outliers_of_colour_are_told_and_those_of_scale_cost_the_others_nothing_to_speak_of():
    scene = random_scene(300, 0)
    scene.log_scales[5, 0] = -19.0
    data, report = encode(scene, "compressed-ply")
    assert not report.warnings
    loss = np.abs(np.sort(decode(data).log_scales, axis=0) - np.sort(scene.log_scales, axis=0))
    assert loss.max() < 0.021
    scene.sh_dc[5] = 400.0
    (line,) = encode(scene, "compressed-ply")[1].warnings
    assert line.startswith("colours of 256 of 300 Gaussians lose up to ")


@pytest.mark.parametrize(
    ("format", "reach", "size"), [("spz", 3e6, 0.02), ("sog", 1e30, 0.001), ("compressed-ply", 1e5, 0.02)]
)
def test_formats_whose_precision_follows_the_farthest_gaussian_say_so(format, reach, size):
    scene = random_scene(300, 0)
    scene.log_scales[:] = np.log(size)
    assert not any("coordinates of" in line for line in encode(scene, format)[1].warnings)
    scene.means[0] = reach
    assert any("coordinates of" in line for line in encode(scene, format)[1].warnings)


@pytest.mark.parametrize("version", [3, 4])
def test_zeros_that_claim_millions_are_refused_before_they_take_memory(version):
    import tracemalloc

    from sw_interchange import spz_packing as packing
    from sw_interchange.spz import MAGIC
    from sw_interchange.spz_fields import field_sizes

    count = 6_000_000
    sizes = field_sizes(count, version, 0)
    head = MAGIC + version.to_bytes(4, "little") + count.to_bytes(4, "little") + bytes([0, 12, 0])
    if version == 3:
        data = b"".join(packing.deflate([head + b"\0", bytes(sum(sizes))], 9))
    else:
        pytest.importorskip("zstandard")
        used = [size for size in sizes if size]
        frames = packing.zstd([bytes(size) for size in used], 3)
        table = b"".join(
            len(f).to_bytes(8, "little") + n.to_bytes(8, "little") for f, n in zip(frames, used, strict=True)
        )
        data = head + bytes([len(used)]) + (32).to_bytes(4, "little") + bytes(12) + table + b"".join(frames)
    tracemalloc.start()
    with pytest.raises(BitstreamError, match=r"claims 6,000,000 Gaussians.*(may stand for at most|too many)"):
        decode(data)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
