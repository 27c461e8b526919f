"""Points on meshes, their thinning, and their distances: worked out by hand, and against brute force."""

import numpy as np
import pytest
from sw_geometry.mesh import Mesh
from sw_geometry.nearest import nearest_points, point_triangle, to_triangles
from sw_geometry.sampling import grid_samples, grid_thinned, thinned, uniform_samples


def triangle(a: tuple[float, float], b: tuple[float, float]) -> Mesh:
    """One triangle in the plane z = 0, from the origin."""
    return Mesh(np.array([[0.0, 0, 0], [*a, 0], [*b, 0]]), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("a", "b", "count"),
    [((1, 0), (0, 1), 6), ((10, 0), (0, 10), 1176), ((0.1, 0), (0, 0.1), 0), ((10, 0), (5, 0.01), 1)],
)
def test_a_triangle_is_sampled_by_the_grid_of_the_protocol(a, b, count):
    found = grid_samples(triangle(a, b), 0.2)
    assert len(found) == 3 + count  # the vertices come first
    assert (found[:3] == triangle(a, b).vertices).all()


def test_the_first_sample_lies_half_a_step_inside():
    assert grid_samples(triangle((1, 0), (0, 1)), 0.2)[3] == pytest.approx([0.125, 0.125, 0])


def test_a_triangle_without_area_has_its_vertices_alone():
    assert len(grid_samples(triangle((1, 0), (2, 0)), 0.2)) == 3


def test_many_triangles_are_sampled_as_each_alone():
    rng = np.random.default_rng(3)
    corners = rng.random((20, 3, 3))
    together = grid_samples(Mesh(corners.reshape(-1, 3), np.arange(60).reshape(-1, 3)), 0.05)
    alone = [grid_samples(Mesh(each, np.array([[0, 1, 2]])), 0.05) for each in corners]
    alone_sorted = np.concatenate([*(a[:3] for a in alone), *(a[3:] for a in alone)])
    assert np.array_equal(together[np.lexsort(together.T)], alone_sorted[np.lexsort(alone_sorted.T)])


def test_uniform_samples_follow_the_area():
    mesh = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9.0, 0, 0], [12, 0, 0], [9, 1, 0]]),
        np.array([[0, 1, 2], [3, 4, 5]]),
    )
    points, rows = uniform_samples(mesh, 4000)
    assert np.bincount(rows).tolist() == [1000, 3000]  # stratified: to one
    assert points[rows == 0].mean(axis=0) == pytest.approx([1 / 3, 1 / 3, 0], abs=0.02)
    assert point_triangle(points, mesh.corners[rows]).max() < 1e-12


def test_thinning_keeps_points_apart_and_drops_none_without_a_kept_neighbour(monkeypatch):
    points = np.random.default_rng(1).random((3000, 3))
    kept = thinned(points, 0.1)
    gaps, _ = nearest_points(points, kept)
    between = np.linalg.norm(kept[:, None] - kept[None], axis=2)[np.triu_indices(len(kept), 1)]
    assert between.min() > 0.1
    assert gaps.max() <= 0.1
    monkeypatch.setattr("sw_geometry.sampling.CHUNK", 17)
    assert np.array_equal(thinned(points, 0.1), kept)


def test_points_at_exactly_the_radius_are_thinned():
    assert len(thinned(np.array([[0.0, 0, 0], [0.5, 0, 0]]), 0.5)) == 1


def test_grid_thinning_keeps_the_point_nearest_to_a_cells_centre():
    points = np.array([[0.1, 0.5, 0.5], [0.4, 0.5, 0.5], [0.9, 0.5, 0.5], [1.2, 0.5, 0.5]])
    assert grid_thinned(points, 1.0, np.zeros(3)).tolist() == [points[1].tolist(), points[3].tolist()]
    assert len(grid_thinned(points, 1.0, np.array([0.5, 0, 0]))) == 2  # another origin: other cells


def soup(seed: int, count: int, scale: float = 0.1) -> Mesh:
    """Triangles of very different sizes anywhere."""
    rng = np.random.default_rng(seed)
    corners = rng.random((count, 1, 3)) + scale * rng.random((count, 1, 1)) ** 4 * rng.normal(size=(count, 3, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def test_the_distance_to_a_mesh_is_that_to_its_nearest_triangle():
    mesh, queries = soup(0, 400, 3.0), np.random.default_rng(5).random((100, 3)) * 3 - 1
    each = point_triangle(np.repeat(queries, len(mesh), axis=0), np.tile(mesh.corners, (len(queries), 1, 1)))
    distance, which = to_triangles(queries, mesh)
    assert distance == pytest.approx(each.reshape(len(queries), -1).min(axis=1), abs=1e-12)
    assert (each.reshape(len(queries), -1).argmin(axis=1) == which).all()


def test_the_distance_to_a_triangle_agrees_with_dense_points_on_it():
    rng = np.random.default_rng(2)
    corners, queries = rng.normal(size=(3, 3)), rng.normal(size=(50, 3)) * 2
    a, b = np.meshgrid(np.linspace(0, 1, 401), np.linspace(0, 1, 401))
    a, b = a[a + b <= 1], b[a + b <= 1]
    dense = corners[0] + a[:, None] * (corners[1] - corners[0]) + b[:, None] * (corners[2] - corners[0])
    found = point_triangle(queries, np.tile(corners, (len(queries), 1, 1)))
    assert found == pytest.approx(nearest_points(queries, dense)[0], abs=0.01)
    assert (found <= nearest_points(queries, dense)[0] + 1e-12).all()


def test_a_triangle_that_is_a_line_or_a_point_has_a_distance():
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]]])
    assert point_triangle(np.array([[1.5, 1, 0], [3.0, 4, 0]]), line) == pytest.approx([1, 5])


def test_there_is_no_distance_to_nothing():
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert to_triangles(np.zeros((2, 3)), empty)[0].tolist() == [np.inf, np.inf]
    assert nearest_points(np.zeros((1, 3)), np.zeros((0, 3)))[0].tolist() == [np.inf]


def test_distances_agree_with_another_kd_tree():
    sklearn = pytest.importorskip("sklearn.neighbors", reason="scikit-learn is not installed")
    rng = np.random.default_rng(8)
    queries, points = rng.random((500, 3)), rng.random((700, 3))
    other, row = sklearn.KDTree(points).query(queries)
    distance, ours = nearest_points(queries, points)
    assert distance == pytest.approx(other[:, 0], rel=1e-12)
    assert (ours == row[:, 0]).all()


def test_distances_agree_with_all_pairs():
    rng = np.random.default_rng(9)
    queries, points = rng.random((300, 3)), rng.random((200, 3))
    pairs = np.linalg.norm(queries[:, None] - points[None], axis=2)
    distance, row = nearest_points(queries, points)
    assert distance == pytest.approx(pairs.min(axis=1), rel=1e-12)
    assert (row == pairs.argmin(axis=1)).all()
