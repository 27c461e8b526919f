"""`sw info`: what it tells of files, runs and scenes."""

import json
import math
import os
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from sw_gaussians.ply import export_ply
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.cli.main import main
from splatwizard_core.coding.container import ContainerWriter
from splatwizard_core.scene.scene import PointCloud


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demo:tiny", "--set", "resolution"], "--set needs key=value"),
        (["demo:tiny", "--set", "iterations=3"], "of no use here"),
        (["demo:tiny", "--set", "principal_point=middle"], "expected one of center, file"),
        (["demo:tiny", "--set", "background=puce"], "expected one of black, white"),
    ],
)
def test_wrong_input_is_a_line_and_status_2(arguments: list[str], message: str, capsys):
    assert main(["info", *arguments]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert message in told.err
    assert 1 <= len(told.err.strip().splitlines()) <= 2


def test_info_of_a_scene_as_json(capsys: pytest.CaptureFixture[str]):
    assert main(["info", "demo:tiny", "--set", "test_every=2", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "scene"
    assert facts["views"] == {"train": 4, "test": 4}


def test_info_draws_a_split_from_above(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["info", "demo:tiny", "--split", "block:0of4", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["views"], facts["pictures"]) == ({"train": 6, "test": 2}, ["demo-tiny-block-0of4.svg"])
    assert facts["protocol"].endswith("/block:0of4/black/pp-center/q8/pts-train")
    assert (tmp_path / "demo-tiny-block-0of4.svg").read_text().count("<path") == 8
    assert main(["info", "demo:tiny", "--split", "block:0of4", "--set", "split=every2"]) == 2
    assert "--split block:0of4 contradicts" in capsys.readouterr().err
    assert main(["info", "demo:tiny"]) == 0
    assert len(list(tmp_path.iterdir())) == 1  # nothing is drawn that was not asked for


def test_info_of_a_file_lists_bytes_that_sum_to_its_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    writer = ContainerWriter("toy", 3, raster={"antialias": True})
    writer.static["note"] = "[bold]not markup[/bold]"
    writer.add("means", b"12345")
    writer.add("sh", b"")
    size = writer.write(tmp_path / "x.swz")
    assert main(["info", str(tmp_path / "x.swz"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "file"
    assert (facts["method"], facts["method_version"]) == ("toy", 3)
    assert facts["bytes"]["means"] == 5
    assert sum(facts["bytes"].values()) == facts["size"] == size
    assert main(["info", str(tmp_path / "x.swz")]) == 0
    text = capsys.readouterr().out
    assert "[bold]not markup[/bold]" in text
    assert f"{size:,}" in text

    (tmp_path / "x.swz").rename(tmp_path / "scene.swz")
    (tmp_path / "config.toml").touch()
    assert main(["info", str(tmp_path)]) == 0  # of a run directory, its file
    assert capsys.readouterr().out == text.replace("x.swz", "scene.swz")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", ["x.ply", "x.swz", "x"])
def test_a_pipe_is_told_as_such(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    os.mkfifo(tmp_path / name)
    assert main(["info", str(tmp_path / name)]) == 2
    assert "no file but a pipe or a device: write what comes out of it into a file first" in capsys.readouterr().err


def test_options_of_drawing_are_shown_where_they_are_not_the_defaults(
    capsys: pytest.CaptureFixture[str], make_run: Callable[..., Path]
):
    for rate, options in (("r1", {}), ("r2", {"profile": "dgr-exact", "antialias": True})):
        drawn = {"raster_options": {"train": {}, "render": options}}
        run = make_run(rate, views=1, change=lambda record, drawn=drawn: record.update(drawn))
        assert main(["info", str(run / "metrics.json")]) == 0
        text = capsys.readouterr().out
        assert ("raster options" in text) is bool(options)
        assert ("render profile dgr-exact, antialias yes" in text) is bool(options)


def test_info_counts_the_gaussians_of_a_ply_that_are_not_finite(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    ply = tmp_path / "grey.ply"
    export_ply(gaussians_from_points(PointCloud(points, torch.full((40, 3), 0.5)), max_sh_degree=1), ply)
    assert main(["info", str(ply), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_gaussians"] == 40
    head, mark, body = ply.read_bytes().partition(b"end_header\n")
    spoiled = tmp_path / "spoiled.ply"
    spoiled.write_bytes(head + mark + struct.pack("<f", math.nan) + body[4:])  # x of the first one
    assert main(["info", str(spoiled), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["num_gaussians"], facts["not_finite"], facts["zero_rotation"]) == (39, 1, 0)
    assert all(-0.5 <= low <= high <= 0.5 for low, high in zip(facts["box"]["min"], facts["box"]["max"], strict=True))
    spoiled.write_bytes(head.replace(b"vertex 40", b"vertex 0") + mark)
    assert main(["info", str(spoiled), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["box"] is None
