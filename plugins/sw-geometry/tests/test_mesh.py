"""Meshes: their order, their pieces, and their files."""

from pathlib import Path

import numpy as np
import pytest
from small_meshes import sphere
from sw_geometry.clusters import cluster_of_triangles, largest_clusters
from sw_geometry.mesh import Mesh, canonical, without_degenerate
from sw_geometry.ply import read_mesh, read_points, write_mesh

from splatwizard_core.api import UserInputError


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + start for m, start in zip(meshes, starts, strict=True)]),
    )


def strays(count: int) -> Mesh:
    corners = np.random.default_rng(0).normal(size=(count, 3, 3)) + 50
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def shuffled(mesh: Mesh, seed: int) -> Mesh:
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    triangles = place[mesh.triangles][rng.permutation(len(mesh))]
    turned = (np.arange(3) + rng.integers(3, size=(len(mesh), 1))) % 3
    colors = None if mesh.colors is None else mesh.colors[order]
    normals = None if mesh.normals is None else mesh.normals[order]
    return Mesh(mesh.vertices[order], np.take_along_axis(triangles, turned, axis=1), normals, colors)


def test_equal_meshes_have_one_order():
    first, second = (canonical(shuffled(sphere(9), seed)) for seed in (1, 2))
    for name in ("vertices", "triangles", "normals", "colors"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_the_order_keeps_the_surface_and_its_outside():
    found = canonical(shuffled(sphere(9), 4))
    outward = (found.crossed() * found.corners.mean(axis=1)).sum(axis=1)
    assert (outward > 0).all()
    assert found.areas().sum() == pytest.approx(sphere(9).areas().sum(), rel=1e-12)


def test_a_turned_over_triangle_is_another_mesh():
    mesh = sphere(5)
    other = Mesh(mesh.vertices, mesh.triangles[:, ::-1])
    assert not np.array_equal(canonical(mesh).triangles, canonical(other).triangles)


def test_one_cluster_keeps_the_largest_piece():
    mesh = joined(sphere(8), sphere(10, (5, 0, 0)), strays(40))
    kept = largest_clusters(mesh, 1)
    assert len(kept) == len(sphere(10))
    assert kept.vertices[:, 0].min() >= 4


def test_pieces_of_few_triangles_go_however_many_may_stay():
    mesh = joined(sphere(8), sphere(10, (5, 0, 0)), strays(40))
    kept = largest_clusters(mesh, 50)
    assert len(kept) == len(sphere(8)) + len(sphere(10))
    assert np.unique(cluster_of_triangles(kept)).tolist() == [0, 1]


def test_more_clusters_than_there_are_and_none_at_all_are_fine():
    assert len(largest_clusters(sphere(8), 1000)) == len(sphere(8))
    assert len(largest_clusters(Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)), 1)) == 0


def test_triangles_that_share_a_corner_alone_are_two_pieces():
    mesh = Mesh(np.random.default_rng(0).random((5, 3)), np.array([[0, 1, 2], [2, 3, 4]]))
    assert len(np.unique(cluster_of_triangles(mesh))) == 2


def test_degenerate_triangles_go_with_their_vertices():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [7, 7, 7]])
    mesh = without_degenerate(Mesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 0, 4]])))
    assert mesh.triangles.tolist() == [[0, 1, 2]]
    assert len(mesh.vertices) == 3


def test_a_mesh_survives_its_file(tmp_path: Path):
    mesh = sphere(7)
    write_mesh(mesh, tmp_path / "mesh.ply")
    found = read_mesh(tmp_path / "mesh.ply")
    assert found.vertices == pytest.approx(mesh.vertices, abs=1e-7)  # float32
    assert np.array_equal(found.triangles, mesh.triangles)
    assert found.normals == pytest.approx(mesh.normals, abs=1e-7)
    assert found.colors == pytest.approx(mesh.colors, abs=0.5 / 255 + 1e-9)
    assert read_points(tmp_path / "mesh.ply") == pytest.approx(mesh.vertices, abs=1e-7)


def test_plyfile_reads_what_is_written(tmp_path: Path):
    from plyfile import PlyData

    write_mesh(sphere(7), tmp_path / "mesh.ply")
    data = PlyData.read(str(tmp_path / "mesh.ply"))
    assert [p.name for p in data["vertex"].properties] == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    assert np.array_equal(np.stack(data["face"]["vertex_indices"]), sphere(7).triangles)


def test_text_files_are_read(tmp_path: Path):
    from plyfile import PlyData

    write_mesh(sphere(4), tmp_path / "mesh.ply")
    data = PlyData.read(str(tmp_path / "mesh.ply"))
    data.text = True
    data.write(str(tmp_path / "text.ply"))
    assert read_mesh(tmp_path / "text.ply").vertices == pytest.approx(sphere(4).vertices, abs=1e-6)
    assert np.array_equal(read_mesh(tmp_path / "text.ply").triangles, sphere(4).triangles)


@pytest.mark.parametrize("damage", ["cut", "claims", "index", "quad", "nan", "empty", "none"])
def test_a_damaged_file_is_told_in_one_line(tmp_path: Path, damage: str):
    path = tmp_path / "mesh.ply"
    write_mesh(Mesh(sphere(4).vertices, sphere(4).triangles), path)
    content = path.read_bytes()
    content = {
        "cut": content[:-5],
        "claims": content.replace(b"element face ", b"element face 99999"),
        "index": content[:-4] + b"\xff\xff\xff\x00",
        "quad": content[:-13] + b"\x04" + content[-12:],
        "nan": content.replace(b"end_header\n", b"end_header\n" + b"\xff" * 4)[:-4],
        "empty": b"",
        "none": b"ply\nformat binary_little_endian 1.0\nend_header\n",
    }[damage]
    path.write_bytes(content)
    with pytest.raises(UserInputError, match=r"mesh\.ply: ") as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


def test_in_the_world_a_vertex_keeps_its_place_to_the_millimetre(tmp_path):
    origin = (448_000.0, 5_411_000.0, 300.0)  # as UTM has it: a float32 has steps of half a metre there
    mesh = Mesh(np.array([[0.001, 0.25, 1.0], [1.0, 0.0, 0.5], [0.0, 1.0, 0.125]]), np.array([[0, 1, 2]]))
    write_mesh(mesh, tmp_path / "world.ply", origin)
    assert b"comment world_coordinates 448000.0 5411000.0 300.0\n" in (tmp_path / "world.ply").read_bytes()
    found = read_mesh(tmp_path / "world.ply").vertices - origin
    np.testing.assert_allclose(found, mesh.vertices, atol=1e-9)  # doubles have steps of 1e-9 there
