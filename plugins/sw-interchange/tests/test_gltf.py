"""glTF: the ratified extension as splat-transform writes it too, and the proposal that puts a .spz inside."""

import json
import os
import shutil
import struct
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interchange_files import covariances, random_scene
from sw_interchange import decode, encode, read, write
from sw_interchange.gltf_writer import SPZ

from splatwizard_core.api import BitstreamError, UserInputError

SPLAT_TRANSFORM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
PYGLTFLIB = os.environ.get("GSPLY_PYTHON")
BASE = "KHR_gaussian_splatting"


def document_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def glb(document: dict[str, Any], blob: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("degree", [0, 3])
def test_the_file_is_what_the_ratified_text_asks_for(degree):
    """Spellings of the extension of June 2026."""
    document, blob = document_of(encode(random_scene(9, degree), "gltf")[0])
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {BASE: {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }}  # fmt: skip
    names = {f"{BASE}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")}
    names |= {f"{BASE}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)}
    assert primitive["attributes"].keys() == names | {"POSITION", "COLOR_0"}
    assert document["extensionsUsed"] == [BASE]
    assert "extensionsRequired" not in document  # who knows no splats draws points
    for accessor, view in zip(document["accessors"], document["bufferViews"], strict=True):
        assert accessor["count"] == 9
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(blob)
    assert {"min", "max"} <= document["accessors"][primitive["attributes"]["POSITION"]].keys()


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_scene_as_spz_inside_is_the_scene_of_that_spz(degree):
    scene = random_scene(50, degree)
    data, report = encode(scene, "gltf", compression="spz_2")
    found, wanted = decode(data), decode(encode(scene, "spz", version=2)[0])
    assert report.bytes == len(data) < len(encode(scene, "gltf")[0]) / 2
    for name in ("means", "log_scales", "sh_dc", "sh_rest", "opacity_logits"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name)), name
    assert np.allclose(covariances(found), covariances(wanted), rtol=1e-5, atol=1e-9)
    assert found.report.stored_frame == "LUF"
    document, _ = document_of(data)
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsRequired"] == [BASE, SPZ]
    assert all("bufferView" not in accessor for accessor in document["accessors"])
    low = document["accessors"][primitive["attributes"]["POSITION"]]["min"]
    assert np.array_equal(np.float32(low), decode(data, frame=None).means.min(0))


def test_a_node_moves_what_is_compressed_too():
    document, blob = document_of(encode(random_scene(5, 1), "gltf", compression="spz_2")[0])
    plain = decode(glb(document, blob), frame=None).means
    document["nodes"][0]["translation"] = [1, 2, 3]
    assert np.allclose(decode(glb(document, blob), frame=None).means, plain + np.float32([1, 2, 3]), atol=1e-6)


BAD = {
    "another compression": ({"KHR_gaussian_splatting_lgsc": {}}, "compressed by KHR_gaussian_splatting_lgsc"),
    "no view": ({SPZ: {}}, "which there is not"),
    "no object": ({SPZ: 7}, "compressed by"),
    "another view": ({SPZ: {"bufferView": 3}}, "which there is not"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_compression_is_refused(name):
    extensions, reason = BAD[name]
    document, blob = document_of(encode(random_scene(5, 1), "gltf", compression="spz_2")[0])
    document["meshes"][0]["primitives"][0]["extensions"][BASE]["extensions"] = extensions
    with pytest.raises(BitstreamError, match=reason):
        decode(glb(document, blob))


@pytest.mark.parametrize(("key", "value"), [("byteLength", 1 << 30), ("byteOffset", 1 << 30), ("byteLength", 20)])
def test_a_view_beyond_its_buffer_is_refused(key, value):
    document, blob = document_of(encode(random_scene(5, 1), "gltf", compression="spz_2")[0])
    document["bufferViews"][0][key] = value
    with pytest.raises(BitstreamError):
        decode(glb(document, blob))


def test_many_primitives_of_one_spz_are_refused():
    document, blob = document_of(encode(random_scene(5, 1), "gltf", compression="spz_2")[0])
    document["meshes"][0]["primitives"] *= 20
    with pytest.raises(BitstreamError, match="too often"):
        decode(glb(document, blob))


def test_a_ply_in_an_archive_is_read(tmp_path):
    scene = random_scene(20, 2)
    for name in ("ply", "compressed-ply"):
        with zipfile.ZipFile(tmp_path / "luma.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("scene/point_cloud.ply", encode(scene, name)[0])
            archive.writestr("scene/README.txt", "hello")
        found = read(tmp_path / "luma.zip")
        assert found.num_gaussians == 20
        assert found.report.format == "zipped-ply"
        assert name != "ply" or np.array_equal(found.sh_rest, scene.sh_rest)


def test_a_bomb_in_an_archive_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.ply", b"ply\n" + bytes(64 << 20))
    with pytest.raises(BitstreamError, match="too many"):
        read(tmp_path / "bomb.zip")


def test_interleaved_sh_is_read_where_that_is_said(tmp_path):
    scene = random_scene(4, 3)
    told = random_scene(4, 3)
    told.sh_rest[:] = scene.sh_rest.reshape(4, 3, 15).transpose(0, 2, 1)  # its file, as planes, is rows of `scene`
    write(told, tmp_path / "a.ply")
    assert np.array_equal(read(tmp_path / "a.ply", sh_layout="interleaved").sh_rest, scene.sh_rest)
    with pytest.raises(UserInputError, match="planar, interleaved"):
        read(tmp_path / "a.ply", sh_layout="other")


@pytest.mark.slow
@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="no splat-transform: make test-interchange")
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_spells_it_alike(tmp_path, degree):
    scene = random_scene(30, degree)
    write(scene, tmp_path / "a.ply")
    write(scene, tmp_path / "ours.glb")
    assert SPLAT_TRANSFORM is not None
    command = [SPLAT_TRANSFORM, "-q", "-w", str(tmp_path / "a.ply"), str(tmp_path / "theirs.glb")]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (ours, _), (theirs, _) = (document_of((tmp_path / f"{name}.glb").read_bytes()) for name in ("ours", "theirs"))
    for document in (ours, theirs):
        (primitive,) = document["meshes"][0]["primitives"]
        document["told"] = {key: value for key, value in primitive.items() if key != "attributes"}
        document["names"] = primitive["attributes"].keys()
    assert ours["told"] == theirs["told"]
    assert ours["names"] == theirs["names"]
    assert ours["extensionsUsed"] == theirs["extensionsUsed"]
    first, second = read(tmp_path / "ours.glb"), read(tmp_path / "theirs.glb")
    assert np.allclose(first.means, second.means, atol=1e-6)
    assert np.allclose(first.sh_rest, second.sh_rest, atol=1e-6)


PROGRAM = """
import sys, pygltflib
gltf = pygltflib.GLTF2().load(sys.argv[1])
primitive = gltf.meshes[0].primitives[0]
view = gltf.bufferViews[gltf.accessors[primitive.attributes.POSITION].bufferView]
sys.stdout.buffer.write(gltf.binary_blob()[view.byteOffset or 0:][:view.byteLength])
"""


@pytest.mark.slow
@pytest.mark.skipif(PYGLTFLIB is None, reason="no pygltflib: make test-interchange")
def test_pygltflib_finds_the_positions(tmp_path: Path):
    scene = random_scene(30, 1)
    write(scene, tmp_path / "a.glb")
    assert PYGLTFLIB is not None
    command = [PYGLTFLIB, "-c", PROGRAM, str(tmp_path / "a.glb")]
    environment = {**os.environ, "PYTHONPATH": ""}
    found = subprocess.run(command, check=True, capture_output=True, timeout=300, env=environment).stdout
    assert np.array_equal(np.frombuffer(found, np.float32).reshape(-1, 3), scene.in_frame("LUF").means)
