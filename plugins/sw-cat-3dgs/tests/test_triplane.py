"""triplane: the frame is the cloud's whatever its pose; integers give the features that floats were trained on."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sw_cat_3dgs.outliers import inliers, local_outlier_factor
from sw_cat_3dgs.principal_frame import FAR, UNIT, PrincipalFrame, contract
from sw_cat_3dgs.triplane import Triplane


def cloud(n=2000, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 3)) * [3, 1, 0.3] + [5, -2, 1]


def lattice(points):
    """(codes, low, step): points as 16-bit codes."""
    low = points.min(axis=0).astype(np.float32)
    step = ((points.max(axis=0) - low) / 65535).astype(np.float32)
    codes = np.clip(np.floor((points - low) / step), 0, 65535).astype(np.int64)
    return torch.from_numpy(codes), low, step


def test_the_outlier_factor_of_four_points_by_hand():
    """Two neighbours each. Densities: 1/1.35, 1/1.3, 1/100.85 and 1/1.35 for -1.1, 0.2, 101.1 and 0.3."""
    points = np.array([[-1.1], [0.2], [101.1], [0.3]])
    # reach(-1.1; 0.2, 0.3) = 1.3, 1.4; reach(0.2; 0.3, -1.1) = 1.4, 1.4; reach(101.1; 0.3, 0.2) = 100.8, 100.9.
    # The neighbourhood distances are 1.4, 1.3, 100.9, 1.4, so reach(0.3; 0.2, -1.1) = 1.3, 1.4.
    density = np.array([2 / 2.7, 2 / 2.8, 2 / 201.7, 2 / 2.7])
    neighbors = [(1, 3), (3, 0), (3, 1), (1, 0)]
    expected = [density[list(pair)].mean() / own for pair, own in zip(neighbors, density, strict=True)]
    assert np.allclose(local_outlier_factor(points, 2), expected, rtol=1e-6)
    assert np.allclose(expected, [0.98214286, 1.03703704, 73.36970899, 0.98214286])


def test_far_points_are_left_out():
    points = np.concatenate([cloud(950), np.random.default_rng(1).uniform(-90, 90, (50, 3))])
    kept = inliers(points)
    assert 0.94 < kept.mean() < 0.96
    assert kept[950:].mean() < 0.15
    assert local_outlier_factor(np.zeros((1, 3))).tolist() == [1.0]
    assert inliers(np.zeros((30, 3))).all()  # duplicates are no outliers


def test_a_similarity_of_the_cloud_leaves_its_coordinates_up_to_signs():
    points = cloud()
    turned = 0.01 * points @ Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix().T + [100, 3, -7]
    a, b = (coordinates(PrincipalFrame.fit(each), each) for each in (points, turned))
    for axis in range(3):
        assert min(np.abs(a[:, axis] - b[:, axis]).max(), np.abs(a[:, axis] + b[:, axis]).max()) < 1e-2


def test_contraction_is_continuous_and_bounded():
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.allclose(contract(directions * (1 - 1e-9)), contract(directions * (1 + 1e-9)), atol=1e-8)
    far = np.linalg.norm(contract(directions * 1e30), axis=1)
    assert (far <= 2 + 1e-12).all()
    assert np.allclose(far, 2)
    assert np.array_equal(contract(np.zeros((1, 3))), np.zeros((1, 3)))


@pytest.mark.parametrize("shape", [cloud(), cloud() * [1, 1, 0], cloud() * [1, 0, 0], cloud(3), cloud(1)])
def test_integer_places_are_those_of_the_float_formula(shape):
    outliers = np.array([[500.0, 0, 0], [0, -800, 30], [5, -2, 40]])
    frame = PrincipalFrame.fit(shape)
    codes, low, step = lattice(np.concatenate([shape, outliers]))
    places = frame.unit(codes, low, step)
    expected = coordinates(frame, codes.numpy() * step.astype(np.float64) + low).clip(-1, 1)
    width = frame.high - frame.low
    exact = places.numpy() / (UNIT / 2) - 1
    # Where the cloud has no width, only the side counts.
    assert np.abs(exact - expected)[:, width > 1e-3].max(initial=0) < 2e-3 / max(
        width[width > 1e-3].min(initial=1), 1e-3
    )
    assert places.min() >= 0
    assert places.max() <= UNIT


def test_places_do_not_depend_on_the_batch():
    points = cloud()
    frame = PrincipalFrame.fit(points)
    codes, low, step = lattice(points)
    one_by_one = torch.cat([frame.unit(row[None], low, step) for row in codes[:50]])
    assert torch.equal(frame.unit(codes, low, step)[:50], one_by_one)


def test_a_frame_survives_its_file_and_nonsense_does_not():
    rows = PrincipalFrame.fit(cloud()).rows()
    assert rows.dtype == np.float32
    assert np.array_equal(PrincipalFrame.from_rows(rows).rows(), rows)
    codes, low, step = lattice(cloud())
    for row, value in ((4, 0), (4, 1e-38), (0, 1e38), (6, 1e20)):
        odd = rows.copy()
        odd[row] = value
        with pytest.raises(ValueError, match="damaged or hostile"):
            PrincipalFrame.from_rows(odd).unit(codes, low, step)


def coordinates(frame, points):
    """[N,3] float64, -1 .. 1 inside the box and more outside: what `unit` computes exactly, in plain floats."""
    mean, axes, std, low, high = (each.astype(np.float64) for each in vars(frame).values())
    place = contract(((points - mean) @ axes / std).clip(-FAR, FAR)) / 4 + 0.5
    return 2 * (place - low) / np.maximum(high - low, 2.0**-18) - 1


def exact_features(integers, places):
    return Triplane.exact_lookup(integers)(places)


def triplane(resolution=5, channels=3, multiples=(1, 2), scale=200.0):
    made = Triplane(resolution, channels, multiples, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for plane in made.planes:
            plane.mul_(scale)
    return made


def test_counts_are_the_papers():
    made = Triplane(53)
    assert made.width == 432
    assert sum(p.numel() for p in made.planes) == 1080 * 53**2
    assert max(p.abs().max() for p in made.planes) <= 0.01


def test_features_are_cumulative_bilinear_samples():
    made = triplane(4, 2)
    low, high = made.planes
    place = torch.tensor([[0, UNIT, UNIT // 3], [UNIT, 0, UNIT]])
    found = made(place, rounded=False)
    # Of the coarse plane (0,1): row of axis 1, column of axis 0.
    assert torch.allclose(found[0, :2], low[0, :, -1, 0])
    assert torch.allclose(found[1, :2], low[0, :, 0, -1])
    # (0,2) at a third of three intervals: row 1 exactly (up to the place's own rounding).
    assert torch.allclose(found[0, 2:4], low[1, :, 1, 0], atol=1e-4)
    assert torch.allclose(found[0, 6:8], low[0, :, -1, 0] + high[0, :, -1, 0])


@pytest.mark.parametrize("resolution", [1, 2, 9])
def test_integers_give_the_features_of_the_floats(resolution):
    made = triplane(resolution)
    places = torch.randint(0, UNIT + 1, (500, 3), generator=torch.Generator().manual_seed(1))
    places = torch.cat([places, torch.tensor([[0, 0, 0], [UNIT] * 3])])
    exact = exact_features(made.integers(), places)
    assert exact.dtype == torch.int64
    # Twelve bits of weight an axis, and one unit lost by the floor.
    assert (exact / 4096 - made(places)).abs().max() < 5e-3
    assert torch.equal(exact[:7], exact_features(made.integers(), places[:7]))
    assert torch.equal(exact[-1:], exact_features(made.integers(), places[-1:]))


def test_gradients_reach_the_planes_through_the_rounding():
    made = triplane()
    places = torch.randint(0, UNIT + 1, (40, 3), generator=torch.Generator().manual_seed(1))
    made(places).square().sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in made.planes)
    with torch.no_grad():
        made.planes[0][0, 0, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        made.integers()


@pytest.mark.cuda
def test_places_and_features_are_the_same_integers_on_cuda():
    frame, made = PrincipalFrame.fit(cloud()), triplane()
    codes, low, step = lattice(cloud())
    places = frame.unit(codes, low, step)
    assert torch.equal(frame.unit(codes.cuda(), low, step).cpu(), places)
    integers = made.integers()
    assert torch.equal(
        exact_features([i.cuda() for i in integers], places.cuda()).cpu(), exact_features(integers, places)
    )
    assert (made.cuda()(places.cuda()).cpu() - made.cpu()(places)).abs().max() < 1e-4
