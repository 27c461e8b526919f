"""`sw compare A B`: errors that are put into a file are found again, whatever order and format it is in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sw_gaussians.picture_psnr import capped_psnr
from sw_gaussians.ply import export_ply, load_ply
from sw_report.attribute_errors import attribute_errors

from splatwizard_core.api import SH_C0, GaussianModel, UserInputError
from splatwizard_core.cli.main import main

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


def model_of(n: int = 200, degree: int = 1, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    return GaussianModel.from_tensors(
        torch.randn(n, 3, generator=g), 0.4 * torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), torch.randn(n, generator=g),
        0.3 * torch.randn(n, 3, generator=g) - 2.5, torch.randn(n, 4, generator=g),
    )  # fmt: skip


def changed(model: GaussianModel, rows: torch.Tensor | None = None, **by: torch.Tensor | float) -> GaussianModel:
    """The model with values added to attributes, and its rows in another order."""
    values = {name: getattr(model, name).detach() + by.get(name, 0.0) for name in model.RAW}
    return GaussianModel.from_tensors(*(value if rows is None else value[rows] for value in values.values()))


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main(["compare", *map(str, arguments), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return facts


def test_known_errors_are_measured():
    a = model_of()
    b = changed(a, means=torch.tensor([3e-3, 0.0, 4e-3]), log_scales=-0.01, sh_dc=0.02 / SH_C0,
                sh_rest=0.03)  # fmt: skip
    found = attribute_errors(a, b)
    assert found is not None
    assert (found.matched, found.rows, found.taken_twice, found.never_taken, found.left_out) == (
        "in order",
        200,
        0,
        0,
        (0, 0),
    )
    errors = found.errors
    assert errors["position"].rms == pytest.approx(5e-3, rel=1e-3)
    assert errors["log_scale"].max == pytest.approx(0.01, rel=1e-3)
    assert errors["log_covariance"].median == pytest.approx(0.01 * np.sqrt(3), rel=1e-3)  # 0.01 times the identity
    assert errors["covariance"].rms == pytest.approx(1 - np.exp(-0.02), rel=1e-3)
    assert errors["color"].rms == pytest.approx(0.02, rel=1e-3)
    assert errors["sh"].rms == pytest.approx(0.03 * np.sqrt(3 / 15), rel=1e-3)  # of 15 coefficients 3 are there
    assert errors["opacity"].max < 1e-6


def test_another_order_and_equal_rotations_make_no_error():
    a = model_of()
    order = torch.randperm(200, generator=torch.Generator().manual_seed(5))
    b = changed(a, order)
    with torch.no_grad():
        b.quats.mul_(-2)  # the same rotations
    found = attribute_errors(a, b)
    assert found is not None
    assert (found.matched, found.taken_twice, found.never_taken) == ("nearest", 0, 0)
    assert max(error.max for error in found.errors.values()) < 2e-6  # float32 quaternions
    # Of two at one place the one that is most alike is the partner.
    twins = changed(a, torch.cat([torch.arange(200), torch.arange(200)]))
    with torch.no_grad():
        twins.sh_dc[:200] += 1.0
    found = attribute_errors(a, twins)
    assert found is not None
    assert found.errors["color"].max < 1e-6
    assert (found.taken_twice, found.never_taken) == (0, 200)


def test_of_a_row_that_is_gone_the_nearest_is_taken_twice_and_that_is_told():
    a = model_of()
    found = attribute_errors(a, changed(a, torch.arange(1, 200)))
    assert found is not None
    assert (found.matched, found.taken_twice, found.never_taken) == ("nearest", 1, 0)
    assert found.errors["position"].median == 0
    assert found.errors["position"].max > 0.01


def test_few_rows_in_another_order_leave_the_order_as_it_is():
    a = model_of(1000)
    order = torch.arange(1000)
    order[[3, 700]] = order[[700, 3]]
    found = attribute_errors(a, changed(a, order))
    assert found is not None
    assert found.matched == "in order"
    assert found.errors["position"].q99 == 0
    assert found.errors["position"].max > 0


def with_axes(model: GaussianModel, order: list[int], turn: float = 0.0) -> GaussianModel:
    """The ellipsoids with their axes in another order (an even one), turned by an angle about the new last axis."""
    w, x, y, z = model.quats.detach().double().unbind(1)
    quarter = torch.tensor({(1, 2, 0): [0.5, 0.5, 0.5, 0.5], (0, 1, 2): [1.0, 0, 0, 0]}[tuple(order)]).double()
    half = torch.tensor([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]).double()

    def times(a, b):
        aw, ax, ay, az = a
        bw, bx, by, bz = b
        return (aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
                aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw)  # fmt: skip

    found = changed(model)
    with torch.no_grad():
        found.quats.copy_(torch.stack(times(times((w, x, y, z), quarter), half), dim=1))
        found.log_scales.copy_(model.log_scales[:, order])
    return found


def test_axes_in_another_order_are_the_same_ellipsoid():
    a = model_of()
    b = with_axes(a, [1, 2, 0])
    assert float((a.log_scales - b.log_scales).detach().abs().max()) > 0.1
    found = attribute_errors(a, b)
    assert found is not None
    assert found.errors["covariance"].max < 1e-5  # it is the same one
    assert found.errors["log_covariance"].max < 1e-5  # float32 quaternions, log scales up to 4
    assert found.errors["log_scale"].max < 1e-6


def test_a_turned_ellipsoid_has_another_log_covariance_and_a_sphere_has_not():
    a = model_of()
    with torch.no_grad():
        a.log_scales.copy_(torch.tensor([-1.0, -3.0, -5.0]).expand(200, 3))
    found = attribute_errors(a, with_axes(a, [0, 1, 2], np.radians(7)))
    assert found is not None
    turned = (
        np.sqrt(2) * abs(-1.0 - -3.0) * np.sin(np.radians(7))
    )  # of two axes with log scales a, b: sqrt(2) |a - b| sin
    assert found.errors["log_covariance"].rms == pytest.approx(turned, rel=1e-4)
    assert found.errors["log_scale"].max < 1e-6
    with torch.no_grad():
        a.log_scales.fill_(-2.0)
    found = attribute_errors(a, with_axes(a, [0, 1, 2], np.radians(7)))
    assert found is not None
    assert found.errors["log_covariance"].max < 1e-6
    assert found.errors["covariance"].max < 1e-6


def test_what_is_not_finite_is_left_out_and_surfels_are_flat():
    a, b = model_of(), model_of()
    with torch.no_grad():
        b.means[3] = torch.nan
    found = attribute_errors(a, b)
    assert found is not None
    assert (found.rows, found.left_out) == (200, (0, 1))
    with torch.no_grad():
        b.means.fill_(torch.nan)
    assert attribute_errors(a, b) is None


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    a = model_of(60)
    export_ply(a, folder / "a.ply")
    order = torch.randperm(60, generator=torch.Generator().manual_seed(5))
    export_ply(changed(a, order, sh_dc=0.1), folder / "b.ply")
    return folder


def test_two_files_without_a_scene_are_seen_by_cameras_that_are_made_up(capsys, monkeypatch, folder: Path):
    monkeypatch.setattr("sw_report.compare.MADE_UP", 3)
    same = run(capsys, folder / "a.ply", folder / "a.ply")
    assert same["psnr"] == {"views": 3, "mean": 100, "least": 100}
    assert same["cameras"] == "made up, plausible"
    facts = run(capsys, folder / "a.ply", folder / "b.ply")
    assert facts["b"] == {"file": str(folder / "b.ply"), "kind": "ply", "bytes": (folder / "b.ply").stat().st_size,
                          "counts": {"num_gaussians": 60}, "sh_degree": 1}  # fmt: skip
    assert 20 < facts["psnr"]["least"] <= facts["psnr"]["mean"] < 60
    assert facts["attributes"]["errors"]["color"]["rms"] == pytest.approx(0.1 * 0.2820948, rel=1e-4)
    assert facts["attributes"]["errors"]["position"]["max"] < 1e-6
    assert main(["compare", str(folder / "a.ply"), str(folder / "b.ply")]) == 0
    told = capsys.readouterr().out
    assert "matched with the nearest mean" in told
    assert f"{facts['psnr']['mean']:.2f} dB" in told


def test_metrics_that_are_named_are_of_b_against_a(capsys, monkeypatch, folder: Path):
    monkeypatch.setattr("sw_report.compare.MADE_UP", 3)
    words = (folder / "a.ply", folder / "b.ply", "--metrics", "ssim,l1")
    found = run(capsys, *words)["metrics"]
    assert found["ssim"]["direction"] == "higher"
    assert 0 < found["ssim"]["mean"] < 1
    assert len(found["l1"]["per_view"]) == 3
    same = run(capsys, words[0], words[0], *words[2:])["metrics"]
    assert same["ssim"]["mean"] == pytest.approx(1, abs=1e-6)  # sums of float32
    assert same["l1"]["mean"] == 0


def test_on_a_scene_both_stand_beside_the_pictures(capsys, folder: Path):
    facts = run(capsys, folder / "a.ply", folder / "b.ply", "--scene", "demo:tiny")
    assert facts["psnr"]["views"] == 2
    assert {"a_to_pictures", "b_to_pictures"} <= set(facts["psnr"])
    assert facts["psnr"]["a_to_pictures"] < facts["psnr"]["mean"]


def test_on_a_scene_models_stand_about_its_origin_wherever_their_files_have_theirs(tmp_path, capsys, folder: Path):
    model = load_ply(folder / "a.ply")
    with torch.no_grad():
        model.means -= torch.tensor([4.0, 0.0, -2.0])
    model.origin = {"world_origin": [4.0, 0.0, -2.0]}
    export_ply(model, tmp_path / "moved.ply")
    facts = run(capsys, folder / "a.ply", tmp_path / "moved.ply", "--scene", "demo:tiny")
    assert facts["attributes"]["errors"]["position"]["max"] < 1e-5
    assert facts["psnr"]["least"] > 60


def test_models_without_attributes_are_seen_by_given_cameras(tmp_path: Path, capsys, folder: Path):
    anchors = GOLDEN / "hac_exact_v2.swz"
    assert main(["compare", str(anchors), str(anchors)]) == 2
    assert "give --scene SCENE or --cameras FILE" in capsys.readouterr().err
    entry = {"width": 32, "height": 24, "fx": 30, "fy": 30, "position": [0, -3, 0.5],
             "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}  # fmt: skip
    (tmp_path / "c.json").write_text(json.dumps([entry]))
    facts = run(capsys, anchors, folder / "a.ply", "--cameras", tmp_path / "c.json")
    assert facts["attributes"] is None
    assert facts["no_attributes"] == "the Gaussians depend on the camera"
    assert facts["psnr"]["views"] == 1


def test_along_a_path_the_flicker_is_told(tmp_path: Path, capsys, folder: Path, monkeypatch):
    entries = [
        {"width": 32, "height": 24, "fx": 30, "fy": 30, "position": [0.05 * t, 0, -4],
         "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]} for t in range(4)
    ]  # fmt: skip
    (tmp_path / "path.json").write_text(json.dumps(entries))
    words = (folder / "a.ply", folder / "b.ply", "--cameras", tmp_path / "path.json", "--path")
    found = run(capsys, *words)["psnr"]["path"]
    assert found["frames"] == 4
    assert 0 < found["flicker"] < 50
    assert found["popping_a"] >= 1
    same = run(capsys, words[0], *words[0:1], *words[2:])["psnr"]["path"]
    assert (same["flicker"], same["flicker1"], same["psnr"]) == (0, 0, None)
    assert main(["compare", *map(str, words)]) == 0
    assert "along the path, 4 frames: flicker" in " ".join(capsys.readouterr().out.split())
    assert main(["compare", str(words[0]), str(words[1]), "--path"]) == 2
    monkeypatch.setenv("PATH", str(tmp_path))
    path = run(capsys, *words, "--path-metrics", "vmaf")["psnr"]["path"]
    assert "ffmpeg with libvmaf" in path["video"]["not_available"]["vmaf"]
    assert main(["compare", *map(str, words), "--path-metrics", "vmaf"]) == 0
    assert "vmaf is not available: program-missing" in " ".join(capsys.readouterr().out.split())


def test_a_run_directory_brings_its_scene(tmp_path: Path, capsys, folder: Path):
    (tmp_path / "config.toml").write_text('method = "3dgs"\nscene = "demo:tiny"\niterations = 3\n')
    arguments = ["encode", str(folder / "a.ply"), "--method", "3dgs", "--rate", "r6", "--out"]
    assert main([*arguments, str(tmp_path / "scene.swz")]) == 0
    capsys.readouterr()
    facts = run(capsys, tmp_path, folder / "a.ply")
    assert facts["cameras"] == "test views of demo-tiny"
    assert facts["psnr"]["mean"] == 100
    assert facts["a"]["kind"] == "3dgs"
    assert load_ply(folder / "a.ply").num_rows == facts["attributes"]["rows"]


def test_runs_of_different_scenes_are_refused_unless_a_scene_or_cameras_are_named(tmp_path: Path, capsys, folder: Path):
    arguments = ["encode", str(folder / "a.ply"), "--method", "3dgs", "--rate", "r6", "--out"]
    runs = []
    for scene in ("demo:tiny", "demo"):
        runs.append(tmp_path / scene.replace(":", "-"))
        runs[-1].mkdir()
        (runs[-1] / "config.toml").write_text(f'method = "3dgs"\nscene = "{scene}"\niterations = 3\n')
        assert main([*arguments, str(runs[-1] / "scene.swz")]) == 0
    capsys.readouterr()
    assert main(["compare", *map(str, runs)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "different scenes, demo and demo:tiny" in said
    assert run(capsys, *runs, "--scene", "demo:tiny")["cameras"] == "test views of demo-tiny"


def test_the_images_of_a_folder_count_among_its_bytes(tmp_path: Path, capsys, monkeypatch, folder: Path):
    pytest.importorskip("sw_interchange")
    monkeypatch.setattr("sw_report.compare.MADE_UP", 1)
    meta = tmp_path / "meta.json"
    assert main(["export", str(folder / "a.ply"), str(meta), "--json"]) == 0
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert json.loads(capsys.readouterr().out)["bytes"] == size > meta.stat().st_size
    assert run(capsys, folder / "a.ply", meta)["b"]["bytes"] == size


def test_pictures_that_are_no_numbers_have_no_psnr():
    picture = torch.full((3, 2, 2), 0.5)
    assert capped_psnr(picture, picture) == 100
    assert capped_psnr(picture, picture + 0.1) == pytest.approx(20, abs=1e-4)
    with pytest.raises(UserInputError, match="no numbers"):
        capped_psnr(picture * torch.nan, picture)


@pytest.mark.parametrize(("arguments", "told"), [
    (["{}/a.ply"], "give two files"), (["{}/a.ply", "{}/b.ply", "{}/a.ply"], "give two files"),
    (["{}/a.ply", "{}/none.ply"], "there is no such file"), (["{}/a.ply", "{}/b.ply", "--own"], "--own is for"),
    (["{}/a.ply", "{}/b.ply", "--path-metrics", "vmaf"], "--path-metrics is for --path"),
    (["{}/a.ply", "{}/b.ply", "--path-metrics", "vmaff"], "give some of cvvdp, vmaf"),
    (["{}/a.ply", "{}/b.ply", "--metrics", "ssimm"], "did you mean 'ssim'"),
    (["{}/a.ply", "{}/b.ply", "--metrics", "path_angle"], "it is not of pictures"),
    (["{}/a.ply", "{}"], "has no scene.swz"), (["{}/a.ply", "{}/b.ply", "--cameras", "{}/a.ply"], "not a JSON file"),
])  # fmt: skip
def test_wrong_input_is_told_in_a_line(capsys, folder: Path, arguments: list[str], told: str):
    assert main(["compare", *(argument.format(folder) for argument in arguments)]) == 2
    said = capsys.readouterr()
    assert told in " ".join(said.err.split())
    assert "Traceback" not in said.err
