"""`sw render`: pictures as before, maps where they are asked for, and what it refuses."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from sw_gaussians.ply import export_ply

from splatwizard_core.api import Camera, GaussianModel, SceneOptions
from splatwizard_core.cli.main import main
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.tooling import load_plugins, load_scene

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"
ONE_OF_EACH_METHOD = sorted({ContainerReader.open(p).method: p for p in sorted(GOLDEN.glob("*.swz"))}.values())
NEAR, FAR = 2.0, 3.0


def walls(camera: Camera, *distances_and_opacities: tuple[float, float]) -> GaussianModel:
    """Gaussians so wide that each is a wall that faces the camera and covers its picture."""
    n = len(distances_and_opacities)
    forward = camera.R[2]
    means = torch.stack([camera.center + z * forward for z, _ in distances_and_opacities])
    logits = torch.tensor([math.log(o / (1 - o)) for _, o in distances_and_opacities])
    return GaussianModel.from_tensors(
        means, torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), logits, torch.full((n, 3), math.log(500.0)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
    )  # fmt: skip


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Camera of view_000."""
    return load_scene("demo:tiny", SceneOptions(), load_plugins()).test[0].camera


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, camera: Camera) -> Path:
    """Two walls as a .ply and as a .swz, and a run directory with that."""
    folder = tmp_path_factory.mktemp("walls")
    export_ply(walls(camera, (NEAR, 0.6), (FAR, 0.99)), folder / "walls.ply")
    run = folder / "run"
    run.mkdir()
    (run / "config.toml").write_text('method = "3dgs"\nscene = "demo:tiny"\niterations = 3\nbackground = "white"\n')
    assert main(["encode", str(folder / "walls.ply"), "--method", "3dgs", "--rate", "r6", "--out",
                 str(run / "scene.swz")]) == 0  # fmt: skip
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main(["render", *map(str, arguments), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return facts


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["render", *map(str, arguments)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "Traceback" not in told.err
    return told.err


def names_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_without_options_there_are_pictures_alone(tmp_path: Path, capsys, folder: Path):
    facts = run(capsys, folder / "walls.ply", "--scene", "demo:tiny", "--out", tmp_path / "views")
    assert facts == {"folder": str(tmp_path / "views"), "files": ["view_000.png", "view_004.png"]}
    assert names_in(tmp_path / "views") == set(facts["files"])
    assert Image.open(tmp_path / "views" / "view_000.png").size == (64, 48)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Path:
    """All maps of the two walls."""
    out = tmp_path_factory.mktemp("drawn")
    status = main(
        ["render", str(folder / "walls.ply"), "--scene", "demo:tiny", "--out", str(out), "--depth",
         "expected,median,inverse,accumulated", "--normals", "--alpha", "--depth-png"]
    )  # fmt: skip
    assert status == 0
    return out


def test_depths_are_those_of_two_walls(drawn: Path, camera: Camera):
    w = 0.6, 0.4 * 0.99
    expected = {
        "expected": (w[0] * NEAR + w[1] * FAR) / sum(w),  # 2.39759
        "median": NEAR,
        "inverse": w[0] / NEAR + w[1] / FAR,
        "accumulated": w[0] * NEAR + w[1] * FAR,
    }
    for mode, value in expected.items():
        with np.load(drawn / f"depth_{mode}" / "view_000.npz") as stored:
            assert sorted(stored.files) == ["K", "R", "depth", "tau"]
            depth = stored["depth"]
            np.testing.assert_array_equal(stored["K"], camera.K)
            np.testing.assert_array_equal(stored["R"], camera.R)
            np.testing.assert_array_equal(stored["tau"], camera.tau)
        assert (depth.dtype, depth.shape) == (np.float32, (48, 64))
        # A wall is a Gaussian of 500 units: its alpha falls by 1e-5 towards the corners.
        np.testing.assert_allclose(depth, value, rtol=2e-5)


def test_normals_face_the_camera_and_say_in_which_frame(drawn: Path, camera: Camera):
    with np.load(drawn / "normals" / "view_000.npz") as stored:
        normals = stored["normals"]
    assert normals.shape == (3, 48, 64)
    inside = normals[:, 1:-1, 1:-1].reshape(3, -1)
    angle = np.degrees(np.arccos(np.clip(-camera.R[2].numpy() @ inside, -1, 1)))
    assert angle.max() < 0.05  # float32 depths: 1e-7 of z between pixels that are 1 / 60 of z apart
    assert not normals[:, 0].any()
    assert not normals[:, :, -1].any()
    picture = np.asarray(Image.open(drawn / "normals" / "view_000.png"))
    assert abs(picture[1:-1, 1:-1].astype(int) - (128, 128, 255)).max() <= 1  # 127.5 rounds either way
    assert not picture[0].any()
    facts = json.loads((drawn / "normals" / "normals.json").read_text())
    assert facts["source"] == "surface"
    assert "world frame" in facts["npz"]


def test_grey_pictures_of_16_bits_hold_depths_by_the_scale_beside_them(drawn: Path):
    for mode in ("expected", "inverse"):
        facts = json.loads((drawn / f"depth_{mode}" / "depth.json").read_text())
        largest = 0.0
        for name in ("view_000", "view_004"):
            values = np.asarray(Image.open(drawn / f"depth_{mode}" / f"{name}.png"))
            depth = np.load(drawn / f"depth_{mode}" / f"{name}.npz")["depth"]
            assert values.max() > 255
            assert ((values == 0) == (depth == 0)).all()
            np.testing.assert_allclose(values / facts["scale"], depth, atol=0.51 / facts["scale"])
            largest = max(largest, float(depth.max()))
        assert facts["scale"] == pytest.approx(65535 / largest)
    assert facts["unit"] == "1 / scene unit"


def test_pictures_for_people_are_there(drawn: Path):
    assert Image.open(drawn / "depth_expected" / "view_000.jpg").size == (64, 48)
    alpha = np.asarray(Image.open(drawn / "alpha" / "view_000.png"))
    assert (alpha == round(255 * 0.996)).all()
    found = names_in(drawn)
    assert {"view_000.png", "depth_median/view_004.npz", "normals/view_004.png"} <= found
    assert not {name for name in found if name.endswith(".exr")}


def test_a_run_directory_stands_for_its_file_on_its_scene(tmp_path: Path, capsys, folder: Path):
    facts = run(capsys, folder / "run", "--depth", "--out", tmp_path, "--views", "all")
    assert len(facts["files"]) == 8
    assert list(facts["maps"]) == ["depth_expected"]
    assert facts["normals"] is None
    assert set(facts["rasterizers"].values()) <= set(load_plugins().rasterizers.names)
    depth = np.load(tmp_path / "depth_expected" / "view_000.npz")["depth"]
    np.testing.assert_allclose(depth, 2.39759, rtol=1e-3)  # the file is quantised
    assert "has no scene.swz" in refused(capsys, folder, "--depth")


def test_options_of_the_rasterizer_reach_the_picture(tmp_path: Path, capsys, camera: Camera):
    model = walls(camera, (4.0, 0.9))
    with torch.no_grad():
        model.log_scales.fill_(math.log(1e-3))
    export_ply(model, tmp_path / "dot.ply")
    brightest = {}
    for sets in ("raster.antialias=false", "raster.antialias=true", "raster.eps2d=4"):
        run(capsys, tmp_path / "dot.ply", "--scene", "demo:tiny", "--out", tmp_path / sets, "--alpha", "--set", sets)
        brightest[sets] = int(np.asarray(Image.open(tmp_path / sets / "alpha" / "view_000.png")).max())
    plain, compensated, wide = brightest.values()
    assert compensated < plain / 3
    assert wide > 0
    facts = run(
        capsys, tmp_path / "dot.ply", "--scene", "demo:tiny", "--out", tmp_path / "p", "--alpha", "--set",
        "raster.profile=dgr-exact",
    )  # fmt: skip
    assert all("profile dgr-exact" in asked for asked in facts["rasterizers"])


def test_gaussians_that_are_not_finite_leave_maps_that_are(tmp_path: Path, capsys, camera: Camera):
    model = walls(camera, (NEAR, 0.9), (FAR, 0.9))
    with torch.no_grad():
        model.means[0] = math.nan
    export_ply(model, tmp_path / "spoiled.ply")
    modes = "expected,median,inverse,accumulated"
    run(capsys, tmp_path / "spoiled.ply", "--scene", "demo:tiny", "--out", tmp_path, "--depth", modes, "--normals")
    for mode in modes.split(","):
        depth = np.load(tmp_path / f"depth_{mode}" / "view_000.npz")["depth"]
        assert np.isfinite(depth).all()
        assert depth.any()
    assert np.isfinite(np.load(tmp_path / "normals" / "view_000.npz")["normals"]).all()


def test_nothing_in_sight_is_no_surface(tmp_path: Path, capsys, camera: Camera):
    export_ply(walls(camera, (-5.0, 0.9)), tmp_path / "behind.ply")
    arguments = ["--scene", "demo:tiny", "--out", tmp_path, "--depth", "expected,median", "--normals", "--depth-png"]
    run(capsys, tmp_path / "behind.ply", *arguments, "--alpha")
    for name in ("depth_expected", "depth_median"):
        assert not np.load(tmp_path / name / "view_000.npz")["depth"].any()
        assert not np.asarray(Image.open(tmp_path / name / "view_000.png")).any()
        assert not np.asarray(Image.open(tmp_path / name / "view_000.jpg")).any()
    assert not np.load(tmp_path / "normals" / "view_000.npz")["normals"].any()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--depth", "mean"], "no mode 'mean': one or more of expected, median"),
        (["--depth", ""], "no mode ''"),
        (["--depth", "surface"], "walls.ply holds no surfels, so it has no depth of a surface: --depth takes expected"),
        (["--normals", "flat"], "no kind 'flat': rendered or surface"),
        (["--normals", "rendered"], "walls.ply holds no surfels, so it has no normals of its own: --normals surface"),
        (["--depth-png"], "add --depth"),
        (["--depth-exr", "--normals"], "add --depth"),
        (["--depth", "expected", "--depth-scale", "0"], "--depth-scale"),
        (["--depth", "expected", "--depth-ratio", "2"], "--depth-ratio"),
        (["--depth", "expected", "--depth-scale", "1e9"], "does not fit into 16 bits: give at most"),
        (["--set", "raster.profile=dgr"], "no rasterizer knows the profile 'dgr': raster.profile is one of 3dgs, dgr"),
        (["--set", "raster.profil=3dgs"], "did you mean 'raster.profile'?"),
        (["--set", "raster.antialias=maybe"], "raster.antialias"),
        (["--set", "raster.eps2d=-1"], "low-pass"),
    ],
)
def test_what_makes_no_sense_is_told_in_a_line(tmp_path: Path, capsys, folder: Path, options: list[str], told: str):
    said = refused(capsys, folder / "walls.ply", "--scene", "demo:tiny", "--out", tmp_path / "views", *options)
    assert told in " ".join(said.split())


def test_a_file_that_an_option_swallows_is_told_where_to_stand(capsys, folder: Path):
    said = refused(capsys, "--depth", folder / "walls.ply")
    assert "one or more of expected, median, inverse, accumulated, surface (FILE goes before it)" in said


def test_rasterizers_without_the_maps_are_answered_with_one_that_has_them(tmp_path: Path, capsys, folder: Path):
    able = [e.name for e in load_plugins().rasterizers if "DEPTH_MEDIAN" in e.declared.get("features", ())]
    arguments = [folder / "walls.ply", "--scene", "demo:tiny", "--out", tmp_path, "--depth", "median"]
    said = refused(capsys, *arguments, "--set", f"raster.forbid={','.join(able)}")
    assert "no rasterizer offers" in said
    assert any(f"{name} (cpu/cuda) is forbidden" in said for name in able)


def test_exr_without_the_library_names_the_extra(tmp_path: Path, capsys, monkeypatch, folder: Path):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    said = refused(capsys, folder / "walls.ply", "--scene", "demo:tiny", "--out", tmp_path, "--depth=expected",
                   "--depth-exr")  # fmt: skip
    assert "--depth-exr needs the package OpenEXR: pip install 'sw-view[exr]'" in said
    assert names_in(tmp_path) == set()


def test_exr_holds_the_same_values(tmp_path: Path, capsys, folder: Path):
    library = pytest.importorskip("OpenEXR")
    run(capsys, folder / "walls.ply", "--scene", "demo:tiny", "--out", tmp_path, "--depth", "--depth-exr")
    with library.File(str(tmp_path / "depth_expected" / "view_000.exr")) as file:
        (name,), pixels = file.channels().keys(), file.channels()["Z"].pixels
    assert name == "Z"
    np.testing.assert_array_equal(pixels, np.load(tmp_path / "depth_expected" / "view_000.npz")["depth"])


@pytest.mark.parametrize("path", ONE_OF_EACH_METHOD, ids=lambda p: p.stem)
def test_a_file_of_any_method_has_depth_and_normals(tmp_path: Path, capsys, path: Path):
    facts = run(capsys, path, "--scene", "demo:tiny", "--out", tmp_path, "--depth", "--normals")
    assert facts["normals"] in ("rendered", "surface")
    with np.load(tmp_path / "depth_expected" / "view_000.npz") as stored:
        assert np.isfinite(stored["depth"]).all()
        assert stored["depth"].max() > 0
    lengths = np.linalg.norm(np.load(tmp_path / "normals" / "view_000.npz")["normals"], axis=0)
    assert np.logical_or(lengths == 0, abs(lengths - 1) < 1e-5).all()
