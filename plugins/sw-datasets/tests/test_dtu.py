"""DTU scans: half size, all views, alpha as mask, the alignments of cameras.npz, and what a hostile one may not do."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from sw_datasets.loaders.colmap import pinhole, pose
from sw_datasets.loaders.dtu import projection_centres, read_alignments

from splatwizard_core.errors import SceneError

SCALE = np.array([[120.0, 0, 0, 5.0], [0, 120.0, 0, -3.0], [0, 0, 120.0, 600.0], [0, 0, 0, 1]])


@pytest.fixture
def scan(colmap_folder, tmp_path):
    """The layout of the prepared archive: images/0000.png RGBA, mask/000.png, cameras.npz, sparse/0."""

    def write(name="scan24", *, alpha=True, masks=True, shift=0.0):
        folder = replace(colmap_folder, root=tmp_path / name, names=[f"{i:04d}.png" for i in range(5)])
        root = folder.write()
        model = folder.model()
        arrays = {}
        fx, fy, cx, cy = pinhole(folder.camera, root)
        for i, image in enumerate(model.images.values()):
            R, tau = pose(image)
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            P = np.eye(4)
            P[:3] = K @ np.concatenate([R.double().numpy(), tau.double().numpy()[:, None] + shift], axis=1)
            arrays[f"world_mat_{i}"] = P @ np.linalg.inv(SCALE)
            arrays[f"scale_mat_{i}"] = SCALE
            arrays[f"camera_mat_{i}"] = np.eye(4)  # there too, and not needed
            rgba = np.full((24, 32, 4), 40 * i, np.uint8)
            rgba[..., 3] = 0
            rgba[4 : 6 + i, 3:9, 3] = 255
            Image.fromarray(rgba if alpha else rgba[..., :3].copy()).save(root / "images" / image.name)
            if masks:
                (root / "mask").mkdir(exist_ok=True)
                Image.fromarray(rgba[..., 3]).convert("RGB").save(root / "mask" / f"{i:03d}.png")
        np.savez(root / "cameras.npz", **arrays)
        return root

    return write


def test_a_scan_is_recognised_and_read_by_its_rules(scan, load):
    scene = load(scan())
    assert scene.protocol.id == "dtu/images/r2/all/black/pp-center/q8"
    assert scene.protocol.name == "survey"
    assert len(scene.train) == len(scene.test) == 5
    assert {(v.camera.width, v.camera.height) for v in scene.train} == {(16, 12)}
    assert scene.warnings == []


def test_another_surface_data_set_in_that_layout_is_no_scan(scan, load):
    assert load(scan("bmvs_bear")).protocol.id == "colmap/images/r-1/every8/black/pp-center/q8/masked"
    assert "'scan7' is not a published scene of DTU" in load(scan("scan7")).warnings[0]


def test_full_size_and_a_split_are_possible_and_said(scan, load):
    scene = load(scan(), resolution=1, split="every5")
    assert scene.protocol.id == "dtu/images/r1/every5/black/pp-center/q8"
    assert scene.protocol.name == "custom"
    assert (len(scene.train), len(scene.test)) == (4, 1)


def test_the_background_is_trained_and_alpha_is_a_mask_alone(scan, load):
    scene = load(scan(), resolution=1)
    view = scene.train[2]
    assert view.pixels.shape == (3, 24, 32)
    assert view.pixels.unique().tolist() == [80]
    assert view.mask.sum() == 4 * 6
    assert view.mask[4:8, 3:9].all()


@pytest.mark.parametrize("alpha", [True, False])
def test_masked_pictures_are_black_outside_their_mask(scan, load, alpha):
    scene = load(scan(alpha=alpha), resolution=1, mask_background=True)
    assert scene.protocol.id.endswith("/masked")
    picture = scene.train[2].image(scene.background)
    assert (picture[:, 4:8, 3:9] == 80 / 255).all()
    assert picture.sum() == pytest.approx(3 * 4 * 6 * 80 / 255)


def test_masks_are_found_by_their_number(scan, load):
    scene = load(scan(alpha=False), resolution=1)
    assert [int(v.mask.sum()) for v in scene.train] == [6 * (2 + i) for i in range(5)]


def test_a_scan_without_any_mask_says_so_and_cannot_be_masked(scan, load):
    root = scan(alpha=False, masks=False)
    assert "no alpha and there is no mask/" in load(root).warnings[0]
    with pytest.raises(SceneError, match=r"mask_background needs a mask for every image, and '0000\.png' has neither"):
        load(root, mask_background=True)


def test_alignments_come_with_the_scene_and_take_it_to_millimetres(scan, load):
    scene = load(scan())
    world, scale = scene.ground_truth["world_mats"], scene.ground_truth["scale_mats"]
    assert world.shape == scale.shape == (5, 4, 4)
    assert world.dtype == torch.float64
    x = torch.tensor([0.3, -0.2, 4.0, 1.0], dtype=torch.float64)
    for i, view in enumerate(sorted(scene.train, key=lambda v: v.name)):
        full = view.camera.resized(32, 24)
        u, v, w = (world[i] @ scale[i] @ x)[:3]
        p = full.R.double() @ x[:3] + full.tau.double()
        assert float(u / w) == pytest.approx(full.fx * float(p[0] / p[2]) + full.cx)
        assert float(v / w) == pytest.approx(full.fy * float(p[1] / p[2]) + full.cy)
    torch.testing.assert_close(scale[0] @ x, torch.tensor([41.0, -27.0, 1080.0, 1.0], dtype=torch.float64))


def test_poses_that_do_not_fit_the_reconstruction_are_told(scan, load):
    assert "stand up to" in load(scan(shift=0.5)).warnings[0]


def test_a_singular_projection_has_no_centre():
    assert projection_centres(torch.zeros(1, 4, 4, dtype=torch.float64)).isnan().all()


@pytest.mark.parametrize("spec", ["dtu/24", "dtu/scan24"])
def test_a_scan_goes_by_its_number_too(scan, load, tmp_path, monkeypatch, spec):
    scan("dtu/scan24")
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    monkeypatch.chdir(tmp_path.parent)
    assert load(spec).name == "scan24"


def npy(array=None, *, header=None, body=b""):
    if header is None:
        stream = io.BytesIO()
        np.save(stream, array, allow_pickle=True)
        return stream.getvalue()
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def archive(path, **members):
    good = npy(np.eye(4))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for kind in ("world_mat_0", "scale_mat_0"):
            content = members.get(kind, good)
            if content is not None:
                file.writestr(f"{kind}.npy", content)
    return path


class Trap:
    def __reduce__(self):
        return (open, ("/nonexistent/trap", "w"))


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 1000000000), }"
SHORT = "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 4), }"
HOSTILE = {
    "a pickle": (npy(np.array([[Trap()] * 4] * 4, dtype=object)), "is object of shape"),
    "a bare pickle": (pickle.dumps(Trap()), "is no array"),
    "a claim of 8 EB": (npy(header=HUGE), r"of shape \(1000000000, 1000000000\)"),
    "too few bytes": (npy(header=SHORT, body=b"\0" * 8), "is no array"),
    "code for a header": (npy(header="__import__('os').getcwd()"), "is no array"),
    "a bomb": (b"\0" * 50_000_000, "is larger than a 4x4 matrix"),
    "text": (npy(np.full((4, 4), "a")), "is <U1 of shape"),
    "nan": (npy(np.full((4, 4), np.nan)), "is not finite"),
    "3x4": (npy(np.eye(4)[:3]), r"of shape \(3, 4\)"),
    "nothing": (b"", "is no array"),
    "another version": (b"\x93NUMPY\x09\x00" + npy(np.eye(4))[8:], "is no array"),
    "absent": (None, "'world_mat_0' is missing; the scene has 1 views"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_matrix_is_one_clear_line(tmp_path, case):
    content, message = HOSTILE[case]
    path = archive(tmp_path / "cameras.npz", world_mat_0=content)
    with pytest.raises(SceneError, match=message) as caught:
        read_alignments(path, 1)
    assert "\n" not in str(caught.value)
    assert "cameras.npz" in str(caught.value)


def test_a_damaged_archive_is_one_clear_line(tmp_path):
    path = archive(tmp_path / "cameras.npz")
    good = path.read_bytes()
    read_alignments(path, 1)
    generator = np.random.default_rng(0)
    refused = 0
    for end in [*range(0, len(good), 7), None]:
        damaged = bytearray(good[:end])
        if end is None:
            damaged[40] ^= 255
        path.write_bytes(bytes(damaged))
        with pytest.raises(SceneError, match=r"cameras\.npz") as caught:
            read_alignments(path, 1)
        assert "\n" not in str(caught.value)
    for _ in range(300):
        damaged = bytearray(good)
        damaged[generator.integers(len(good))] = generator.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            read_alignments(path, 1)
        except SceneError:
            refused += 1
    assert refused > 100


def test_matrices_that_unpack_in_one_read_are_refused(tmp_path):
    """1.5 kB of bzip2 took 4.1 GB: zipfile reads no less than a block."""
    with zipfile.ZipFile(tmp_path / "cameras.npz", "w", zipfile.ZIP_BZIP2) as file:
        for kind in ("world_mat_0", "scale_mat_0"):
            file.writestr(f"{kind}.npy", npy(np.eye(4)))
    with pytest.raises(SceneError, match=r"'world_mat_0\.npy' is compressed by bzip2: pack it again with deflate"):
        read_alignments(tmp_path / "cameras.npz", 1)
