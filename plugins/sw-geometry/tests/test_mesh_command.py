"""`sw mesh` and `sw eval --geometry` on a finished run of the small procedural scene."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sw_datasets.demo import dataset as demo
from sw_geometry.command import _target
from sw_geometry.open3d_import import import_open3d
from sw_geometry.ply import read_mesh

from splatwizard_core.api import CapabilityError, UserInputError
from splatwizard_core.cli.main import main

ROOT = Path(__file__).parents[3]
FINISHED = ROOT / "tests" / "golden" / "runs_0_1" / "finished" / "demo-tiny" / "speedy-splat" / "r3"
EVAL = ["eval", str(FINISHED / "scene.swz"), "--scene", "demo:tiny", "--no-speed", "--metrics", "l1", "--json"]
COARSE = ["--voxel-size", "0.05"]


@pytest.fixture
def no_open3d(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    import_open3d.cache_clear()
    yield
    import_open3d.cache_clear()


@pytest.fixture
def open3d():
    try:
        return import_open3d()
    except CapabilityError as error:
        pytest.skip(str(error))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    shutil.copytree(FINISHED, tmp_path / "r3")
    return tmp_path / "r3"


@pytest.mark.usefixtures("no_open3d")
def test_without_open3d_it_says_what_to_install_and_touches_nothing(run, capsys):
    assert main(["mesh", str(run)]) == 1
    told = capsys.readouterr().err
    assert "pip install 'sw-geometry[mesh]'" in told
    assert len(told.splitlines()) == 1
    assert not (run / "mesh").exists()


@pytest.mark.pipeline
@pytest.mark.usefixtures("no_open3d")
def test_an_evaluation_without_open3d_has_what_needs_none(capsys):
    assert main([*EVAL, "--geometry"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert set(found["metrics"]) == {"l1", "chamfer", "mesh_f1", "depth_error", "normal_error"}
    assert 0 < found["metrics"]["depth_error"]["mean"] < 1
    assert found["geometry"]["depth_error"]["abs_rel"] == found["metrics"]["depth_error"]["mean"]
    assert 0 < found["geometry"]["normal_error"]["median"] < 90
    assert found["metrics"]["chamfer"]["mean"] is None
    assert found["unknown"]["metrics.chamfer.mean"].startswith("package-missing: ")
    assert captured.err.count("pip install 'sw-geometry[mesh]'") == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [(["no-such-file"], "no-such-file"), (["{run}", "--depth", "nearest"], "metrics.mesh.depth"),
     (["{run}", "--set", "metrics.mesh.voxelsize=1"], "did you mean 'metrics.mesh.voxel_size'"),
     (["{run}", "--voxel-size", "0"], "--voxel-size")],
)  # fmt: skip
def test_wrong_input_is_told_before_the_work(run, capsys, arguments, told):
    assert main(["mesh", *(each.format(run=run) for each in arguments)]) == 2
    assert told in capsys.readouterr().err
    assert not (run / "mesh").exists()


@pytest.mark.pipeline
@pytest.mark.usefixtures("open3d")
def test_a_run_gets_a_mesh_that_is_the_same_every_time(run, capsys, monkeypatch):
    assert main(["mesh", str(run), *COARSE, "--chamfer"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("mesh: ")
    assert str(run / "mesh" / "mesh_post.ply") in out[0]
    assert out[1] == "protocol: analytic"
    files = {path.name: path.read_bytes() for path in (run / "mesh").iterdir()}
    assert set(files) == {"mesh.ply", "mesh_post.ply", "mesh.png", "mesh.json"}
    facts = json.loads(files["mesh.json"])
    assert facts["voxel_size"] == 0.05
    assert facts["views_used"] == 6
    assert facts["triangles_post"] == len(read_mesh(run / "mesh" / "mesh_post.ply"))
    assert facts["chamfer"]["overall"] == (facts["chamfer"]["acc"] + facts["chamfer"]["comp"]) / 2

    # Made again, and interrupted before the last file: no mesh.json says that the rest is whole.
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sw_geometry.files.save_pictures", interrupted)
    assert main(["mesh", str(run), *COARSE]) == 130
    assert not (run / "mesh" / "mesh.json").exists()
    for name in ("mesh.ply", "mesh_post.ply"):
        assert (run / "mesh" / name).read_bytes() == files[name]
    assert sorted(path.name for path in (run / "mesh").iterdir()) == ["mesh.ply", "mesh.png", "mesh_post.ply"]


@pytest.mark.pipeline
@pytest.mark.usefixtures("open3d")
def test_an_evaluation_has_the_mesh_and_keeps_its_files(tmp_path, capsys):
    more = ["--geometry", "--renders", str(tmp_path), "--set", "metrics.mesh.voxel_size=0.05"]
    assert main([*EVAL, *more, "--set", "metrics.mesh.points=true"]) == 0
    found = json.loads(capsys.readouterr().out)
    chamfer = found["geometry"]["chamfer"]
    assert chamfer["overall"] == found["metrics"]["chamfer"]["mean"]
    assert chamfer["protocol"] == "analytic"
    assert chamfer["mesh"]["voxel_size"] == 0.05
    assert found["geometry"]["chamfer_points"]["protocol"] == "analytic-points"
    assert (tmp_path / "geometry" / "mesh.json").exists()
    assert "chamfer_dtu" not in found["metrics"]


@pytest.mark.usefixtures("open3d")
def test_a_scene_without_truth_cannot_be_measured(run, capsys, monkeypatch):
    monkeypatch.setattr("sw_geometry.chamfer.Truth.of", lambda scene: None)
    assert main(["mesh", str(run), *COARSE, "--chamfer"]) == 2
    assert "brings no surface to compare with" in capsys.readouterr().err


def test_a_file_for_the_mesh_is_written_and_nothing_else(run, open3d, tmp_path, capsys):
    target = tmp_path / "surface.ply"
    assert main(["mesh", str(run), *COARSE, "--out", str(target), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["folder"], facts["files"]) == (str(tmp_path), ["surface.ply"])
    assert facts["triangles_post"] == len(read_mesh(target))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r3", "surface.ply"]
    assert not (run / "mesh").exists()


def test_a_mesh_of_a_scene_that_was_moved_can_be_moved_back(run, open3d, tmp_path, capsys, monkeypatch):
    """As `sw export --world` does."""
    words, far = ["mesh", str(run), *COARSE, "--out"], (448_000.0, 5_411_000.0, 300.0)
    assert main([*words, str(tmp_path / "near.ply")]) == 0
    load = demo.DemoDataset.load
    monkeypatch.setattr(demo.DemoDataset, "load", lambda *given: replace(load(*given), origin=far))
    capsys.readouterr()
    assert main([*words, str(tmp_path / "local.ply")]) == 0
    assert f"local origin, which lies at {far} (--world adds it)" in capsys.readouterr().out
    assert main([*words, str(tmp_path / "world.ply"), "--world"]) == 0
    assert "--world" not in capsys.readouterr().out
    near, local, world = (read_mesh(tmp_path / f"{name}.ply") for name in ("near", "local", "world"))
    np.testing.assert_allclose(local.vertices, near.vertices, atol=1e-6)
    np.testing.assert_allclose(world.vertices - far, near.vertices, atol=1e-6)


def test_a_file_is_told_from_a_folder_by_its_suffix(tmp_path):
    (tmp_path / "old.ply").mkdir()
    for name in ("mesh", "old.ply"):  # as earlier releases made one
        assert _target(None, None, str(tmp_path / name)) == tmp_path / name
    assert _target(None, None, str(tmp_path / "new.ply")) == tmp_path / "new.ply"
    with pytest.raises(UserInputError, match="there is no folder"):
        _target(None, None, str(tmp_path / "none" / "new.ply"))


def test_a_file_in_a_folder_that_is_not_there_is_refused_before_the_work(run, tmp_path, capsys):
    assert main(["mesh", str(run), "--out", str(tmp_path / "none" / "surface.ply")]) == 2
    assert "there is no folder" in capsys.readouterr().err
