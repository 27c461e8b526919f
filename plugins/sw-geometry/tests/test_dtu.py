"""The DTU protocol on a scan that the test writes: culling, millimetres, distances, and files that are missing."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from sw_geometry import dtu
from sw_geometry.culling import in_view, kept_vertices, widened
from sw_geometry.mesh import Floats, Mesh
from sw_geometry.ply import write_mesh

from splatwizard_core.api import CapabilityError, UserInputError


def bump(count: int, size: float, shift: float = 0.0) -> Mesh:
    """A square plane at z = 2 mm with a bump, moved along its normals by `shift`."""
    x, y = np.meshgrid(np.linspace(0, size, count), np.linspace(0, size, count), indexing="ij")
    r2 = ((x - size / 2) ** 2 + (y - size / 2) ** 2) / (size / 4) ** 2
    z = 2 + 2 * np.exp(-r2)
    slope = -4 * np.exp(-r2) / (size / 4) ** 2
    normal = np.stack([-slope * (x - size / 2), -slope * (y - size / 2), np.ones_like(z)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    points = (np.stack([x, y, z], axis=2) + shift * normal).reshape(-1, 3)
    at = np.arange(count * count).reshape(count, count)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The official files of a scan 24 whose truth is `bump`."""
    found: Path = tmp_path_factory.mktemp("dtu_gt")
    (found / "Points" / "stl").mkdir(parents=True)
    (found / "ObsMask").mkdir()
    truth = bump(161, 16.0)  # 0.1 mm apart
    write_mesh(Mesh(truth.vertices, np.zeros((0, 3), dtype=np.int64)), found / "Points" / "stl" / "stl024_total.ply")
    content = {"ObsMask": np.ones((50, 50, 50), dtype=np.uint8), "BB": np.array([[-20.0] * 3, [29.0] * 3]), "Res": 1.0}
    savemat(found / "ObsMask" / "ObsMask24_10.mat", content)
    savemat(found / "ObsMask" / "Plane24.mat", {"P": np.array([[0.0, 0, 1, -1]])})
    return found


@pytest.fixture(scope="module")
def official(folder: Path) -> dtu.Official:
    return dtu.read_official(folder, 24)


def test_the_truth_itself_has_no_distance(official: dtu.Official):
    found = dtu.mesh_distance(bump(81, 16.0), official)
    assert found["d2s"] <= 0.1
    assert found["s2d"] <= 0.1
    assert found["overall"] == (found["d2s"] + found["s2d"]) / 2


def test_a_mesh_one_millimetre_off_is_one_millimetre_off(official: dtu.Official):
    found = dtu.mesh_distance(bump(81, 16.0, shift=1.0), official)
    assert found["overall"] == pytest.approx(1.0, abs=0.05)


def test_a_mesh_out_of_sight_has_a_reason(official: dtu.Official):
    with pytest.raises(UserInputError, match=r"no distance \(d2s\) is below 20 mm"):
        dtu.mesh_distance(bump(41, 16.0).moved(1.0, np.array([0, 0, 24.5])), official)
    with pytest.raises(UserInputError, match="in millimetres"):
        dtu.mesh_distance(bump(41, 16.0).moved(1.0, np.array([500.0, 0, 0])), official)


def test_what_lies_below_the_table_does_not_count_as_missing(official: dtu.Official):
    below = dtu.Official(
        np.concatenate([official.points, official.points - [0, 0, 12]]),
        official.observed, official.box, official.resolution, official.plane,
    )  # fmt: skip
    mesh = bump(81, 16.0)
    assert dtu.mesh_distance(mesh, below)["s2d"] == pytest.approx(dtu.mesh_distance(mesh, official)["s2d"])


def test_points_in_space_that_was_not_observed_do_not_count(official: dtu.Official):
    mesh, stray = bump(41, 16.0), bump(41, 16.0, shift=10.0)
    both = Mesh(
        np.concatenate([mesh.vertices, stray.vertices]),
        np.concatenate([mesh.triangles, stray.triangles + len(mesh.vertices)]),
    )
    blind = np.array(official.observed)
    blind[:, :, 29:] = False  # from z = 8.5 mm on
    hidden = dtu.Official(official.points, blind, official.box, official.resolution, official.plane)
    assert dtu.mesh_distance(both, official)["d2s"] > 4
    assert dtu.mesh_distance(both, hidden)["d2s"] < 0.1


def test_a_voxel_holds_what_rounds_to_it_half_to_even(official: dtu.Official):
    # z + 20 of the three points: 22.5 -> 22, 23.5 -> 24, 24.5 -> 24.
    points = np.array([[0.0, 0, 2.5], [0, 0, 3.5], [0, 0, 4.5]])
    seen = np.zeros((50, 50, 50), dtype=bool)
    seen[20, 20, 24] = True
    only = dtu.Official(np.array([[0.0, 0, 3.5]]), seen, official.box, 1.0, official.plane)
    lone = Mesh(points, np.zeros((0, 3), dtype=np.int64))
    assert dtu.mesh_distance(lone, only)["d2s"] == pytest.approx(0.5)  # (0 + 1) / 2: the second and the third
    seen[20, 20, 22] = True
    assert dtu.mesh_distance(lone, only)["d2s"] == pytest.approx(2 / 3)


def test_the_box_reaches_60_mm_below_and_120_above(official: dtu.Official):
    truth = np.array([[0.0, 0, 5.0]])
    one = dtu.Official(truth, official.observed, official.box, 1.0, official.plane)
    for z, near in ((-80.0, True), (-80.01, False), (148.9, True), (149.0, False)):
        far = dtu.Official(np.array([[0, 0, z + (9 if z > 0 else -9)]]), *(getattr(one, n) for n in (
            "observed", "box", "resolution")), np.array([0.0, 0, 0, 1]))  # fmt: skip
        mesh = Mesh(np.array([[0.0, 0, 5], [0, 0, z]]), np.zeros((0, 3), dtype=np.int64))
        if near:  # then the point is a target of completeness, 9 mm off
            with pytest.raises(UserInputError, match="d2s"):
                dtu.mesh_distance(mesh, far)
            assert dtu.point_distance(mesh.vertices, far)["s2d"] == pytest.approx(9)
        else:
            assert dtu.point_distance(mesh.vertices, far)["s2d"] == 20


def test_distances_of_points_are_clipped_not_dropped(official: dtu.Official):
    near = official.points[::50]
    found = dtu.point_distance(np.concatenate([near, [[28.0, 28, 28]]]), official)
    alone = dtu.point_distance(near, official)
    assert alone["d2s"] < 0.01
    assert found["d2s"] > alone["d2s"]
    assert found["d2s"] < 20 / 50


@pytest.mark.parametrize("name", ["Points/stl/stl024_total.ply", "ObsMask/ObsMask24_10.mat", "ObsMask/Plane24.mat"])
def test_a_missing_file_is_named_with_where_it_comes_from(folder: Path, tmp_path: Path, name: str):
    for path in sorted(folder.rglob("*.*")):
        copy = tmp_path / path.relative_to(folder)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if str(path.relative_to(folder)) != name:
            copy.write_bytes(path.read_bytes())
    with pytest.raises(CapabilityError, match=r"^dtu-gt-missing: .*roboimagedata\.compute\.dtu\.dk") as caught:
        dtu.read_official(tmp_path, 24)
    assert str(tmp_path / name) in str(caught.value)


def test_a_scan_without_official_files_is_told_which_have_some(folder: Path):
    with pytest.raises(CapabilityError, match="scan 1 has no official evaluation files; the 15 scans are"):
        dtu.read_official(folder, 1)


@pytest.mark.parametrize(("name", "number"), [("scan24", 24), ("dtu/scan105", 105), ("24", 24), ("garden", None)])
def test_scans_are_known_by_their_number(name: str, number: int | None):
    assert dtu.scan_number(name) == number


@pytest.mark.parametrize("damage", ["text", "ObsMask", "BB", "P"])
def test_a_damaged_official_file_is_told_in_one_line(folder: Path, tmp_path: Path, damage: str):
    for path in sorted(folder.rglob("*.*")):
        copy = tmp_path / path.relative_to(folder)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    if damage == "text":
        (tmp_path / "ObsMask" / "Plane24.mat").write_text("no matrix")
    elif damage == "P":
        savemat(tmp_path / "ObsMask" / "Plane24.mat", {"P": np.zeros((1, 3))})
    else:
        content = {"ObsMask": np.ones((2, 2, 2)), "BB": np.zeros((2, 3)), "Res": 1.0}
        del content[damage]
        savemat(tmp_path / "ObsMask" / "ObsMask24_10.mat", content)
    with pytest.raises(UserInputError, match=r"24(_10)?\.mat: ") as caught:
        dtu.read_official(tmp_path, 24)
    assert "\n" not in str(caught.value)


def projection(shift: float = 0.0) -> Floats:
    """A camera at z = -10 that looks along z, f = 100 px, centre of a picture of 201 x 101; `shift` along x."""
    K = np.array([[100.0, 0, 100, 0], [0, 100, 50, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    E = np.eye(4)
    E[:3, 3] = shift, 0, 10
    return K @ E


def test_a_point_is_kept_by_all_views_or_by_any():
    everywhere, nowhere = np.ones((101, 201), dtype=bool), np.zeros((101, 201), dtype=bool)
    points = np.array([[0.0, 0, 0], [0, 0, -20], [50, 0, 0]])  # in the picture, behind the camera, beside the picture
    one, other = (projection(), everywhere), (projection(0.5), nowhere)
    assert kept_vertices(points, [one, other], "all").tolist() == [False, True, True]
    assert kept_vertices(points, [one, other], "any").tolist() == [True, False, False]
    assert kept_vertices(points, [one, other], "none").all()
    assert kept_vertices(points, [one], "all").all()


def test_a_projection_of_the_other_sign_is_the_same_camera():
    mask = np.ones((101, 201), dtype=bool)
    points = np.array([[0.0, 0, 0], [0, 0, -20]])
    for sign in (1, -1):
        assert in_view(points, sign * projection(), mask)[0].tolist() == [True, False]


def test_the_border_pixels_centres_are_outside():
    mask = np.ones((101, 201), dtype=bool)
    at = np.array([[-10.0, 0, 0], [-9.99, 0, 0], [10, 0, 0], [9.99, 0, 0]])  # x = 0, 0.1, 200, 199.9 px
    assert in_view(at, projection(), mask)[0].tolist() == [False, True, False, True]


def test_masks_are_sampled_at_the_nearest_pixel():
    mask = np.zeros((101, 201), dtype=bool)
    mask[50, 100] = True
    at = np.array([[0.04, 0, 0], [0.06, 0, 0], [0, -0.04, 0], [0, -0.06, 0]])  # 0.4 and 0.6 px aside
    assert in_view(at, projection(), mask)[1].tolist() == [True, False, True, False]


def test_a_mask_is_widened_by_a_disk():
    morphology = pytest.importorskip("skimage.morphology")
    mask = np.random.default_rng(0).random((60, 80)) > 0.995
    assert np.array_equal(widened(mask, 7), morphology.dilation(mask, morphology.disk(7)))
    assert not widened(np.zeros((5, 5), dtype=bool), 3).any()
