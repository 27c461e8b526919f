"""`sw bake`: explicit Gaussians of a file of anchors, and what it says they cost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from sw_gaussians.ply import load_ply

from splatwizard_core.cli.main import main

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


@pytest.mark.parametrize("name", ["hac_exact_v2", "hac_plus_v1", "cat_3dgs_refined_v2", "compact3dgs_v1"])
def test_a_file_whose_gaussians_depend_on_the_camera_is_made_explicit(tmp_path: Path, capsys, name: str):
    out = tmp_path / "out.ply"
    file = str(GOLDEN / f"{name}.swz")
    assert main(["export", file, str(out)]) == 2
    assert "sw bake FILE OUT --scene SCENE" in " ".join(capsys.readouterr().err.split())
    assert main(["bake", file, str(out), "--scene", "demo:tiny", "--sh-degree", "1", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    model = load_ply(out)
    assert facts["counts"] == {"num_gaussians": model.num_rows}
    assert model.max_sh_degree == 1
    assert (facts["format"], facts["bytes"], facts["cameras"]) == ("ply", out.stat().st_size, 6)
    psnr = facts["psnr"]
    assert psnr["to_model_at_fitted"] > 20
    assert abs(psnr["model_at_test"] - psnr["baked_at_test"]) < 3


def test_the_explicit_file_asks_for_what_was_drawn(tmp_path: Path):
    arguments = ["--scene", "demo:tiny", "--sh-degree", "0", "--set", "raster.antialias=true"]
    assert main(["bake", str(GOLDEN / "hac_exact_v2.swz"), str(tmp_path / "o.ply"), *arguments]) == 0
    assert load_ply(tmp_path / "o.ply").origin["raster"] == {"antialias": True}


def test_cameras_of_a_file_and_refining_are_told(tmp_path: Path, capsys):
    facing = [[[1, 0, 0], [0, 0, 1], [0, -1, 0]], [[-1, 0, 0], [0, 0, -1], [0, -1, 0]]]  # +y and -y
    entries = [
        {"width": 32, "height": 24, "fx": 30, "fy": 30, "position": [0, y, 0.5], "rotation": rotation}
        for y, rotation in zip((-3, 3), facing, strict=True)
    ]
    (tmp_path / "c.json").write_text(json.dumps(entries))
    arguments = ["bake", str(GOLDEN / "hac_exact_v2.swz"), str(tmp_path / "o.ply"), "--scene", "demo:tiny", "--cameras",
                 str(tmp_path / "c.json")]  # fmt: skip
    found = []
    for steps in ("0", "20"):
        assert main([*arguments, "--refine", steps, "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["cameras"] == 2
        assert list(facts["psnr"]) == ["to_model_at_fitted"]
        found.append(facts["psnr"]["to_model_at_fitted"])
    assert found[1] > found[0]


def test_wrong_input_is_told_in_a_line(tmp_path: Path, capsys):
    assert main(["bake", str(GOLDEN / "3dgs_r1_v1.swz"), str(tmp_path / "o.ply"), "--scene", "demo:tiny"]) == 2
    assert "explicit already" in capsys.readouterr().err
    assert main(["bake", str(GOLDEN / "hac_exact_v2.swz"), str(tmp_path / "o.xyz"), "--scene", "demo:tiny"]) == 2
    assert "no installed exporter writes '.xyz' files" in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_a_format_that_nobody_writes_is_refused_before_the_fitting(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr("sw_view.drawing.open_drawing", lambda *_: pytest.fail("the file was opened"))
    assert main(["bake", str(GOLDEN / "hac_exact_v2.swz"), str(tmp_path / "o.xyz"), "--scene", "demo:tiny"]) == 2
    assert "no installed exporter writes '.xyz' files" in " ".join(capsys.readouterr().err.split())


@pytest.mark.cuda
def test_a_gpu_bakes_what_the_cpu_bakes(tmp_path: Path, capsys):
    found = {}
    for device in ("cpu", "cuda"):
        arguments = ["bake", str(GOLDEN / "hac_exact_v2.swz"), str(tmp_path / f"{device}.ply"), "--scene", "demo:tiny"]
        assert main([*arguments, "--device", device, "--refine", "3", "--json"]) == 0
        found[device] = json.loads(capsys.readouterr().out)
    assert found["cpu"]["counts"] == found["cuda"]["counts"]
    cpu, cuda = (each["psnr"]["baked_at_test"] for each in found.values())
    assert cuda == pytest.approx(cpu, abs=0.05)  # sums in another order, three steps of Adam
