"""Scene -> format -> scene: every field within the bounds of the format's description, in every frame and degree."""

import importlib.util
import io
import json
import struct
import zipfile
from itertools import pairwise

import numpy as np
import pytest
import zstandard
from interchange_files import random_scene
from sw_interchange import GaussianScene, decode, encode, formats, read, write
from sw_interchange.order import morton_order
from sw_interchange.scene import sigmoid
from sw_interchange.splat import ROW
from sw_interchange.spz_fields import field_sizes
from sw_interchange.spz_packing import inflate

from splatwizard_core.api import SceneError, UserInputError
from splatwizard_core.tooling import bytes_with_named

SCALE_ULPS = 5  # of e^x: a float32 near -8 is known to 2^-22, which are 4, and exp rounds once more
WRITTEN = [f.name for f in formats() if f.writes and (f.name[:3] != "usd" or importlib.util.find_spec("pxr"))]
"""Formats that can be written and read again here: those of OpenUSD need usd-core (make test-interchange)."""
SIZES = [1, 255, 256, 257, 1500]


def rotation_error(a: GaussianScene, b: GaussianScene) -> float:
    """Largest angle between the rotations of two scenes, degrees."""
    half_chord = np.minimum(
        np.linalg.norm(a.quats.astype(np.float64) - b.quats, axis=1),
        np.linalg.norm(a.quats.astype(np.float64) + b.quats, axis=1),
    )
    return float(np.degrees(4 * np.arcsin(np.clip(half_chord / 2, 0, 1))).max())


def errors(a: GaussianScene, b: GaussianScene) -> dict[str, float]:
    found = {name: float(np.abs(getattr(a, name) - getattr(b, name)).max(initial=0)) for name in
             ("means", "log_scales", "sh_dc", "sh_rest")}  # fmt: skip
    found["alpha"] = float(np.abs(sigmoid(a.opacity_logits) - sigmoid(b.opacity_logits)).max())
    return found | {"rotation": rotation_error(a, b)}


def ulps(a: np.ndarray, b: np.ndarray) -> int:
    """Largest difference of positive float32, in steps of their last bit; of others 0 or more than enough."""
    bits = [np.ascontiguousarray(each).view(f"u{each.dtype.itemsize}").astype(np.int64) for each in (a, b)]
    return int(np.abs(bits[0] - bits[1]).max())


def spz_planes(data: bytes) -> list[bytes]:
    """Positions, alphas, colours, scales, rotations and SH, as bytes."""
    if data[:4] == b"NGSP":
        table = struct.unpack_from(f"<{2 * data[15]}Q", data, 32)
        places = np.cumsum([32 + 8 * len(table), *table[::2]])
        return [zstandard.decompress(data[at:end]) for at, end in pairwise(places)]
    plain = inflate(data, 1 << 24, "")
    places = np.cumsum([16, *field_sizes(*struct.unpack_from("<I", plain, 8), plain[4], plain[12])])
    return [plain[at:end] for at, end in pairwise(places)]


def gltf_columns(data: bytes) -> dict[str, np.ndarray]:
    """Attribute -> its values."""
    size = struct.unpack_from("<I", data, 12)[0]
    told, blob = json.loads(data[20 : 20 + size]), data[28 + size :]
    found = {}
    for name, number in told["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = told["accessors"][number]
        view = told["bufferViews"][accessor["bufferView"]]
        raw = blob[view["byteOffset"] :][: view["byteLength"]]
        found[name] = np.frombuffer(raw, {5126: "<f4", 5121: "u1"}[accessor["componentType"]])
    return found


def check(scene: GaussianScene, found: GaussianScene, **bounds: float) -> None:
    assert found.frame == "RDF"
    assert found.sh_degree == scene.sh_degree
    for name, error in errors(scene, found).items():
        assert error <= bounds.get(name, 0) + 2e-6, name


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("n", SIZES)
def test_ply_keeps_every_bit(n, degree):
    scene = random_scene(n, degree)
    data, report = encode(scene, "ply")
    found = decode(data)
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert np.array_equal(getattr(found, name), getattr(scene, name))
    assert (report.lost, found.report.num_gaussians, encode(found, "ply")[0]) == ([], n, data)


@pytest.mark.parametrize("n", SIZES)
def test_splat(n):
    scene = random_scene(n, 0)
    data = encode(scene, "splat", order="given")[0]
    found = decode(data, "splat")
    check(scene, found, log_scales=1e-6, alpha=1 / 510, sh_dc=0.00696, rotation=0.87)
    assert len(data) == 32 * n
    first, second = (np.frombuffer(each, ROW) for each in (data, encode(found, "splat", order="given")[0]))
    for name in ("means", "rgba"):
        assert np.array_equal(first[name], second[name])
    assert ulps(first["scales"], second["scales"]) <= SCALE_ULPS
    off = np.abs(first["quats"].astype(int) - second["quats"])  # the code of a quaternion is not of length 1
    assert off.max() <= 1
    assert off.any(1).mean() < 0.03 or n == 1
    order = encode(scene, "splat")[0]
    weight = decode(order, "splat")
    size = np.exp(weight.log_scales.sum(1)) * sigmoid(weight.opacity_logits)
    assert (np.diff(size) <= 0.01 * size.max()).all(), "the largest and most opaque first"  # codes of alpha are coarse


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", range(4))
def test_spz(degree, version):
    scene = random_scene(1500 if degree == 3 else 257, degree)
    data, report = encode(scene, "spz", version=version)
    found = decode(data)
    check(scene, found, means=1.2208e-4, log_scales=1 / 32, sh_dc=0.01308, alpha=1 / 510, sh_rest=8.5 / 128,
          rotation=13 if version == 2 else 0.25)  # fmt: skip
    assert np.abs(found.sh_rest[:, :3] - scene.sh_rest[:, :3]).max(initial=0) <= 4.5 / 128
    assert (report.clamped, found.report.version, found.report.stored_frame) == ({}, str(version), "RUB")
    # All but rotations, whose largest component may tie after rounding, keep their codes the second time.
    first, second = (spz_planes(each) for each in (data, encode(found, "spz", version=version)[0]))
    rotations = first.pop(4), second.pop(4)
    assert first == second
    differ = (np.frombuffer(each, np.uint8).reshape(scene.num_gaussians, -1) for each in rotations)
    assert np.not_equal(*differ).any(1).mean() <= (0 if version == 2 else 0.01)


@pytest.mark.parametrize("n", SIZES)
def test_spz_of_any_size(n):
    scene = random_scene(n, 1)
    for version in (3, 4):
        assert decode(encode(scene, "spz", version=version)[0]).num_gaussians == n


def test_spz_of_a_large_scene_has_fewer_fractional_bits_and_of_a_huge_one_is_refused():
    scene = random_scene(10, 0)
    scene.means[0, 0] = 5000
    data, report = encode(scene, "spz")
    found = decode(data)
    assert "10 fractional bits" in report.warnings[0]
    assert np.abs(found.means - scene.means).max() <= 2**-11
    scene.means[0, 0] = 1e7
    with pytest.raises(UserInputError, match="reaches to 1e"):
        encode(scene, "spz")


def test_spz_4_of_many_equal_gaussians_is_one_that_readers_believe():
    scene = random_scene(1, 0).select(np.zeros(300_000, int))
    data, _ = encode(scene, "spz", version=4)
    assert len(data) * 1024 // 9 >= 300_000
    assert decode(data).num_gaussians == 300_000


def test_spz_options():
    scene = random_scene(300, 3)
    fine = decode(encode(scene, "spz", sh1_bits=8, sh_bits=8, fractional_bits=16, antialiased=True)[0])
    assert np.abs(fine.sh_rest - scene.sh_rest).max() <= 0.5 / 128 + 1e-6
    assert np.abs(fine.means - scene.means).max() <= 2**-17 + 1e-6
    assert fine.antialiased
    raw = encode(scene, "spz", frame="raw")[0]
    assert np.abs(decode(raw, spz_frame="raw").means - scene.means).max() < 2e-4
    assert np.abs(decode(raw).means - scene.means * (1, -1, -1)).max() < 2e-4
    assert decode(raw, frame=None).frame == "RUB"


def test_spz_of_degree_4_needs_version_4():
    scene = random_scene(7, 4)
    assert decode(encode(scene, "spz", version=4)[0]).sh_degree == 4
    data, report = encode(scene, "spz", version=3)
    assert decode(data).sh_degree == 3
    assert "degree 4" in report.lost[0]


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (255, 1), (256, 2), (257, 3), (1500, 3)])
def test_compressed_ply(n, degree):
    scene = random_scene(n, degree)
    ordered = scene.select(morton_order(scene.means))
    found = decode(encode(scene, "compressed-ply")[0])
    assert found.report.format == "compressed-ply"
    sizes = {}
    for name in ("means", "log_scales", "sh_dc"):
        values = getattr(ordered, name)
        starts = np.arange(0, n, 256)
        extent = np.maximum.reduceat(values, starts) - np.minimum.reduceat(values, starts)
        steps = np.array([510, 510, 510] if name == "sh_dc" else [4094, 2046, 4094])
        sizes[name] = float((extent / steps).max()) * 1.01
    check(ordered, found, **sizes, alpha=1 / 510, sh_rest=1 / 64, rotation=0.26)


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (257, 1), (1500, 3)])
def test_sog(n, degree):
    scene = random_scene(n, degree)
    ordered = scene.select(morton_order(scene.means))
    data, report = encode(scene, "sog", palette=n)
    found = decode(data)
    check(ordered, found, means=1e-3, log_scales=0.04, sh_dc=0.02, alpha=1 / 255, sh_rest=0.02, rotation=0.99)
    assert found.report.version == "2"
    assert report.errors.get("sh_rest_rmse", 0) < 0.01
    assert encode(scene, "sog", palette=n)[0] == data, "a file depends on the scene alone"


def test_sog_with_a_small_palette_tells_its_error():
    scene = random_scene(1500, 3)
    ordered = scene.select(morton_order(scene.means))
    data, report = encode(scene, "sog", palette=64)
    found = decode(data)
    rmse = float(np.sqrt(((ordered.sh_rest - found.sh_rest) ** 2).mean()))
    assert rmse == pytest.approx(report.errors["sh_rest_rmse"], rel=1e-4)
    assert 0.1 < rmse < 0.2  # of 0.2: random vectors have no clusters
    assert len(data) < len(encode(scene, "sog")[0])


def test_sog_as_a_folder(tmp_path):
    scene = random_scene(40, 1)
    report = write(scene, tmp_path / "meta.json")
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "means_l.webp", "means_u.webp", "meta.json", "quats.webp", "scales.webp", "sh0.webp", "shN_centroids.webp",
        "shN_labels.webp",
    ]  # fmt: skip
    assert report.format == "sog-folder"
    there, bundle = read(tmp_path), decode(encode(scene, "sog")[0])
    assert np.array_equal(there.sh_rest, bundle.sh_rest)
    (tmp_path / "sh0.webp").unlink()
    with pytest.raises(UserInputError, match=r"sh0\.webp"):
        read(tmp_path)


def test_two_scenes_in_one_folder_keep_their_images(tmp_path):
    scenes = {"a": random_scene(30, 1), "größer b": random_scene(30, 1, seed=1)}
    for name, scene in scenes.items():
        write(scene, tmp_path / f"{name}.json")
    for name, scene in scenes.items():
        found, wanted = read(tmp_path / f"{name}.json"), decode(encode(scene, "sog")[0])
        assert np.array_equal(found.means, wanted.means)
        assert np.array_equal(found.sh_rest, wanted.sh_rest)
        images = sum(file.stat().st_size for file in tmp_path.glob(f"{name}_*.webp"))
        assert bytes_with_named(tmp_path / f"{name}.json") == images + (tmp_path / f"{name}.json").stat().st_size
    with pytest.raises(UserInputError, match=r"write a meta\.json"):
        write(scenes["a"], tmp_path / "a:b.json")
    assert len([*tmp_path.iterdir()]) == 16


@pytest.mark.parametrize("bits", [0x3F80007B, 0x3F807B20, 0x3F808B1F])
def test_a_splat_may_begin_like_text_or_gzip(bits, tmp_path):
    scene = random_scene(2, 0)
    scene.means[0, 0] = np.uint32(bits).view(np.float32)
    data, _ = encode(scene, "splat", order="given")
    (tmp_path / "a.splat").write_bytes(data)
    assert np.array_equal(read(tmp_path / "a.splat").means, scene.means)
    write(scene, tmp_path / "meta.json")
    others = {"spz": encode(scene, "spz")[0], "sog": (tmp_path / "meta.json").read_bytes()}
    for name, other in others.items():  # another format is not .splat because it is called so
        (tmp_path / "b.splat").write_bytes(other.ljust(-(-len(other) // 32) * 32))
        assert read(tmp_path / "b.splat").report.format == name


def test_an_archive_may_hold_the_files_in_a_folder():
    data = encode(random_scene(5, 0), "sog")[0]
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(f"scene/{name}", old.read(name))
    assert decode(buffer.getvalue()).num_gaussians == 5


@pytest.mark.parametrize("degree", range(4))
def test_gltf(degree):
    scene = random_scene(257, degree)
    data, _ = encode(scene, "gltf")
    found = decode(data)
    check(scene, found, means=0, log_scales=2e-6, alpha=2e-7, rotation=1e-3)
    assert found.report.stored_frame == "LUF"
    first, second = (gltf_columns(each) for each in (data, encode(found, "gltf")[0]))
    inexact = {"KHR_gaussian_splatting:SCALE": SCALE_ULPS, "KHR_gaussian_splatting:OPACITY": 8}  # ln and logit, undone
    assert first.keys() == second.keys() > inexact.keys()
    for name, values in first.items():
        assert ulps(values, second[name]) <= inexact.get(name, 0), name


@pytest.mark.parametrize("name", [name for name in WRITTEN if name not in ("splat", "sog-folder")])
def test_the_order_of_sh_survives(name):
    """No format mixes up coefficients and channels: rest[k][c] stands where it stood."""
    for degree in (1, 2, 3):
        scene = random_scene(3, degree)
        k = scene.sh_rest.shape[1]
        scene.sh_rest[:] = (np.arange(k)[:, None] + 20 * np.arange(3)) / 64 - 0.4
        found = decode(encode(scene, name)[0])
        assert np.abs(found.sh_rest - scene.sh_rest).max() < 0.07


@pytest.mark.parametrize("name", ["ply", "spz", "compressed-ply", "sog"])
def test_that_a_scene_was_trained_with_antialiasing_is_kept(name):
    scene = random_scene(4, 0)
    scene.antialiased = True
    assert decode(encode(scene, name)[0]).antialiased


@pytest.mark.parametrize("name", ["ply", "sog"])
def test_surfels_stay_surfels(name):
    scene = random_scene(4, 0)
    scene.kind = "2dgs"
    scene.log_scales[:, 2] = -20
    found = decode(encode(scene, name)[0])
    assert found.kind == "2dgs"
    assert np.allclose(found.log_scales[:, 2], -20, atol=0.1)


@pytest.mark.parametrize("name", ["splat", "spz", "compressed-ply", "gltf"])
def test_that_surfels_become_ellipsoids_is_told(name):
    scene = random_scene(4, 0)
    assert encode(scene, name)[1].lost == []
    scene.kind = "2dgs"
    scene.log_scales[:, 2] = -20
    data, report = encode(scene, name)
    assert report.lost == ["that these are surfels: they are flat ellipsoids"]
    assert decode(data, name).kind == "default"


@pytest.mark.parametrize("name", ["splat", "gltf"])
def test_scales_beyond_float32_are_clamped_and_counted(name):
    scene = random_scene(4, 0)
    scene.log_scales[1] = (95, -110, 88)
    data, report = encode(scene, name)
    assert report.clamped == {"log_scales": 2}
    found = decode(data, name)
    assert (found.num_gaussians, found.report.dropped) == (4, 0)
    row = found.log_scales[np.abs(found.log_scales).max(1).argmax()]
    assert np.allclose(row, [88.72, -87.33, 88], atol=1e-4)


@pytest.mark.parametrize("name", [name for name in WRITTEN if name != "ply"])
def test_rows_that_are_no_numbers_are_left_out_and_told(name):
    scene = random_scene(6, 1)
    scene.means[0, 0], scene.sh_rest[1, 0, 0], scene.opacity_logits[2] = np.nan, np.inf, np.inf
    data, report = encode(scene, name)
    assert report.num_gaussians == 4
    assert "2 Gaussians" in report.warnings[0]
    assert name == "sog-folder" or decode(data, name).num_gaussians == 4


def test_ply_rows_that_are_no_numbers_are_dropped_or_refused_when_read():
    scene = random_scene(6, 1)
    scene.means[0, 0] = np.nan
    scene.opacity_logits[1], scene.log_scales[2, 1], scene.quats[3] = -np.inf, -np.inf, 0
    found = decode(data := encode(scene, "ply")[0])
    assert (found.num_gaussians, found.report.dropped) == (4, 2)
    assert found.report.left_out == {"not_finite": 1, "zero_rotation": 1}
    assert found.report.repairs == {"opacity_logits": 1, "log_scales": 1}
    assert np.isfinite(found.log_scales).all()
    with pytest.raises(UserInputError, match="2 Gaussians mean nothing"):
        decode(data, strict=True)


def test_a_scene_without_gaussians_is_a_ply_and_nothing_else():
    empty = random_scene(3, 1).select(np.zeros(3, bool))
    assert decode(encode(empty, "ply")[0]).num_gaussians == 0
    for name in ("splat", "spz", "sog", "gltf", "compressed-ply"):
        with pytest.raises(UserInputError, match="without Gaussians"):
            encode(empty, name)


def test_unknown_options_and_formats_are_refused_with_a_hint(tmp_path):
    scene = random_scene(2, 0)
    with pytest.raises(UserInputError, match="did you mean 'version'"):
        encode(scene, "spz", verison=4)
    with pytest.raises(UserInputError, match="2, 3, 4"):
        encode(scene, "spz", version=5)
    with pytest.raises(UserInputError, match="no format 'spx'"):
        encode(scene, "spx")
    with pytest.raises(UserInputError, match="no format has this suffix"):
        write(scene, tmp_path / "scene.usd")
    with pytest.raises(UserInputError, match="has no writer"):
        encode(scene, "ksplat")
    with pytest.raises(SceneError, match="cannot be read"):
        read(tmp_path / "absent.spz")
