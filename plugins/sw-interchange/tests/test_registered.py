"""Through the registry: `sw export`, `sw info` and `sw eval` take these files as they take a .ply."""

import json
from pathlib import Path

import numpy as np
import pytest
from interchange_files import ksplat_file, random_scene
from sw_gaussians.ply import load_ply
from sw_interchange import GaussianScene, decode, read, write
from sw_interchange.export_command import in_world

from splatwizard_core.api import ContainerReader, SceneError, SplatModel, UserInputError
from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import export_model

SUFFIXES = [".splat", ".spz", ".sog", ".compressed.ply", ".glb", ".json"]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return random_scene(30, 1)


@pytest.fixture(scope="module")
def ply(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write(scene, path)
    return path


def test_a_ply_is_exported_as_it_is(ply, tmp_path):
    again = tmp_path / "again.ply"
    assert main(["export", str(ply), str(again)]) == 0
    assert again.read_bytes() == ply.read_bytes()


def test_the_world_is_asked_for_only_where_it_is_known(ply):
    model = load_ply(ply)
    with pytest.raises(UserInputError, match=r"--world: m\.ply does not say where its origin lies"):
        in_world(model, "m.ply")
    with pytest.raises(UserInputError, match=r"--world: m\.swz holds no explicit Gaussians, its own.*sw bake"):
        in_world(type("Anchors", (SplatModel,), {})(), "m.swz")
    model.origin = {"world_origin": [448262.0, 5411933.0, 35.0]}
    assert model.world_shift is None
    assert in_world(model, "m.ply").world_shift == (448262.0, 5411933.0, 35.0)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ply_goes_out_and_comes_back(ply, scene, tmp_path, suffix, capsys):
    there, back = tmp_path / f"scene{suffix}", tmp_path / "back.ply"
    assert main(["export", str(ply), str(there)]) == 0
    assert main(["export", str(there), str(back), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.partition("\n")[2])["counts"] == {"num_gaussians": 30}
    model = load_ply(back)
    assert model.max_sh_degree == (0 if suffix == ".splat" else 1)
    nearest = np.abs(model.means.detach().numpy()[:, None] - scene.means).max(-1).min(1)
    assert nearest.max() < 0.01


def test_info_tells_format_version_and_axes(ply, tmp_path, capsys):
    write(read(ply), tmp_path / "a.spz", version=4, antialiased=True)
    assert main(["info", str(tmp_path / "a.spz"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["kind"], facts["version"], facts["stored_frame"], facts["sh_degree"]) == ("spz", "4", "RUB", 1)
    assert (facts["antialiased"], facts["num_gaussians"]) == (True, 30)


def test_that_a_file_was_trained_with_antialiasing_is_asked_of_the_rasterizer(ply, tmp_path):
    write(read(ply), tmp_path / "a.spz", antialiased=True)
    model = load_plugins().importers.load("spz")(tmp_path / "a.spz")
    assert model.origin["raster"] == {"antialias": True}
    write(read(ply), tmp_path / "b.spz")
    assert load_plugins().importers.load("spz")(tmp_path / "b.spz").origin["raster"] == {}


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".json"])
def test_antialiasing_goes_through_the_command_and_back(ply, tmp_path, suffix):
    write(read(ply), tmp_path / "a.spz", antialiased=True)
    there, back = tmp_path / f"there{suffix}", tmp_path / "back.spz"
    assert main(["export", str(tmp_path / "a.spz"), str(there)]) == 0
    assert read(there).antialiased
    assert load_plugins().read_gaussians(there).origin["raster"] == {"antialias": True}
    assert main(["export", str(there), str(back)]) == 0
    assert read(back).antialiased


def test_a_page_is_drawn_as_the_file_asks(ply, tmp_path):
    for name, antialiased in (("a", True), ("b", False)):
        write(read(ply), tmp_path / f"{name}.spz", antialiased=antialiased)
        assert main(["export", str(tmp_path / f"{name}.spz"), str(tmp_path / f"{name}.html")]) == 0
        assert f'"antialias":{int(antialiased)}' in (tmp_path / f"{name}.html").read_text()


def test_an_encoded_file_asks_for_what_its_ply_asked(ply, tmp_path):
    write(read(ply), tmp_path / "a.spz", antialiased=True)
    assert main(["export", str(tmp_path / "a.spz"), str(tmp_path / "a.ply")]) == 0
    assert main(["encode", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.swz"), "--method", "spz"]) == 0
    file = ContainerReader.open(tmp_path / "a.swz")
    assert file.raster["antialias"] is True
    assert decode(file.section("file"), "spz").antialiased
    assert main(["export", str(tmp_path / "a.swz"), str(tmp_path / "b.ply")]) == 0
    assert read(tmp_path / "b.ply").antialiased
    plain = ["--method", "spz", "--set", "raster.antialias=false"]
    assert main(["encode", str(tmp_path / "a.ply"), "--out", str(tmp_path / "c.swz"), *plain]) == 0
    assert "antialias" not in ContainerReader.open(tmp_path / "c.swz").raster


@pytest.mark.pipeline
def test_a_ply_and_its_copies_are_drawn_alike(tmp_path, capsys):
    scene = random_scene(200, 0)
    scene.means *= 0.3  # in front of the cameras
    scene.log_scales[:] = -6  # below a pixel, where antialiasing counts
    scene.opacity_logits[:] = 3
    scene.antialiased = True
    write(scene, tmp_path / "a.ply")
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "a.spz")]) == 0
    capsys.readouterr()
    found = []
    for chosen in ([], ["--set", "raster.antialias=true"], ["--set", "raster.antialias=false"]):
        files = [str(tmp_path / "a.ply"), str(tmp_path / "a.spz")]
        assert main(["compare", *files, "--scene", "demo:tiny", "--json", *chosen]) == 0
        found.append(json.loads(capsys.readouterr().out)["psnr"])
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize("suffix", [".spz", ".ply"])
def test_a_low_pass_filter_of_its_own_is_told_as_lost(ply, tmp_path, caplog, suffix):
    model = load_plugins().read_gaussians(ply)
    model.origin = {"raster": {"eps2d": 0.1}}
    export_model(model, tmp_path / f"a{suffix}", load_plugins())
    assert "not kept: its low-pass filter of 0.1 px^2" in caplog.text


@pytest.mark.pipeline
def test_a_file_is_measured_on_a_scene(ply, tmp_path, capsys):
    write(read(ply), tmp_path / "a.sog")
    assert main(["eval", str(tmp_path / "a.sog"), "--scene", "demo:tiny", "--no-speed", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["counts"] == {"num_gaussians": 30}
    assert facts["metrics"]["psnr"]["mean"] > 0


def test_what_a_format_does_not_keep_is_told(ply, tmp_path, caplog):
    export_model(load_plugins().read_gaussians(ply), tmp_path / "a.splat", load_plugins())
    assert "not kept: SH degree 1" in caplog.text


def test_a_ksplat_is_read(tmp_path):
    for level in range(3):
        for degree in range(3):
            path = tmp_path / f"{level}{degree}.ksplat"
            path.write_bytes(ksplat_file(2, level, degree))
            model = load_plugins().read_gaussians(path)
            assert model.num_rows == 5
            assert model.max_sh_degree == degree


def test_ksplat_places_records_in_their_buckets_and_bands_in_their_order(tmp_path):
    path = tmp_path / "a.ksplat"
    data = bytearray(ksplat_file(2, 2, 2))
    body = 4096 + 1024
    centres = np.frombuffer(bytes(data[body + 4 : body + 40]), "<f4").reshape(3, 3)
    records, size = body + 40, 6 + 6 + 8 + 4 + 24
    for i in range(5):
        at = records + i * size
        data[at : at + 6] = np.array([32767, 65534, 0], "<u2").tobytes()  # the middle of the bucket, and its ends
        data[at + 24 : at + 48] = bytes(range(24))
    path.write_bytes(data)
    found = read(path)
    assert np.allclose(found.means, np.repeat(centres, [2, 2, 1], axis=0) + np.array([0, 2.5, -2.5]), atol=1e-4)
    codes = (found.sh_rest[0] + 1.5) / 3 * 255
    bands = [[0, 3, 6], [1, 4, 7], [2, 5, 8], *([9 + i, 14 + i, 19 + i] for i in range(5))]
    assert np.allclose(codes, bands, atol=1e-3)


def test_what_depends_on_the_camera_is_refused(tmp_path):
    with pytest.raises(SceneError, match="depend on the camera"):
        export_model(SplatModel(), tmp_path / "a.spz", load_plugins())


def test_a_damaged_file_is_one_line_of_the_command(tmp_path, capsys):
    (tmp_path / "a.spz").write_bytes(b"\x1f\x8b nonsense")
    assert main(["info", str(tmp_path / "a.spz")]) == 2
    assert "a.spz" in (error := capsys.readouterr().err)
    assert len(error.splitlines()) == 1
    write(random_scene(3, 0), tmp_path / "b.ply", format="compressed-ply")
    with pytest.raises(UserInputError, match=r"compressed \.ply"):
        load_ply(tmp_path / "b.ply")
    assert read(tmp_path / "b.ply").report.format == "compressed-ply"


def test_info_tells_what_a_meta_json_describes(ply, tmp_path, capsys):
    write(read(ply), tmp_path / "meta.json", format="sog-folder")
    assert main(["info", str(tmp_path / "meta.json"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["kind"], facts["num_gaussians"]) == ("sog-folder", 30)


def test_info_tells_what_an_index_of_levels_describes(ply, tmp_path, capsys):
    (tmp_path / "unit").mkdir()
    write(read(ply), tmp_path / "unit" / "meta.json", format="sog-folder")
    leaf = {"bound": {"min": [-9, -9, -9], "max": [9, 9, 9]}, "lods": {"0": {"file": 0, "offset": 0, "count": 30}}}
    index = {"version": 1, "count": 30, "counts": [30], "lodLevels": 1, "filenames": ["unit/meta.json"], "tree": leaf}
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    assert main(["info", str(tmp_path / "lod-meta.json"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["kind"], facts["num_gaussians"]) == ("streamed-sog", 30)


def test_the_cut_of_degree_4_is_told(tmp_path, caplog):
    write(random_scene(5, 4), tmp_path / "a.spz", version=4)
    assert load_plugins().read_gaussians(tmp_path / "a.spz").max_sh_degree == 3
    assert "a.spz: its SH degree is 4" in caplog.text
