"""Merging: exact moments, the ink that two or more show together, and the price of a pair."""

import math

import numpy as np
import pytest
import torch
from sw_gaussians import face, merging, simplifying
from sw_gaussians.merge_costs import closeness, columns_of, prices
from sw_gaussians.merging import Splats, covariances, merge_groups, surface
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.principal_axes import quaternions
from sw_gaussians.simplifying import level_counts, merged_to

from splatwizard_core.api import GaussianModel


def random_splats(groups: int, members: int, seed: int = 0) -> Splats:
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    return Splats(
        draw(groups, members, 3), torch.exp(draw(groups, members, 3) * 0.7 - 0.5),
        torch.nn.functional.normalize(draw(groups, members, 4), dim=-1),
        torch.sigmoid(draw(groups, members)), draw(groups, members, 4, 3),
    )  # fmt: skip


def rounds(count: int, alpha: float, distance: float = 0.0, scale: float = 1.0) -> Splats:
    """`count` flat discs in the plane z = 0, a distance apart."""
    means = torch.zeros(1, count, 3, dtype=torch.float64)
    means[0, :, 0] = distance * torch.arange(count)
    scales = torch.tensor([scale, scale, 0.01 * scale], dtype=torch.float64).expand(1, count, 3)
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, count, 4)
    return Splats(means, scales, quats, torch.full((1, count), alpha, dtype=torch.float64),
                  torch.zeros(1, count, 1, 3, dtype=torch.float64))  # fmt: skip


def covariance(splats: Splats) -> torch.Tensor:
    return covariances(splats.scales, torch.nn.functional.normalize(splats.quats, dim=-1))


@pytest.mark.parametrize("members", [2, 4])
def test_moments_are_exact(members):
    groups = random_splats(50, members)
    found = merge_groups(groups)
    weights = groups.opacities * surface(groups.scales)
    weights = weights / weights.sum(1, keepdim=True)
    mean = (weights[..., None] * groups.means).sum(1)
    d = groups.means - mean[:, None]
    expected = (weights[..., None, None] * (covariance(groups) + d[..., :, None] * d[..., None, :])).sum(1)
    # float64, numbers of about 1
    assert torch.allclose(found.means, mean, atol=1e-10)
    assert torch.allclose(covariance(found), expected, atol=1e-10)
    assert torch.allclose(found.sh, (weights[..., None, None] * groups.sh).sum(1), atol=1e-10)


def test_the_surface_of_a_sphere_is_that_of_a_sphere():
    assert float(surface(torch.full((3,), 2.0, dtype=torch.float64))) == pytest.approx(4 * math.pi * 4)


@pytest.mark.parametrize(("rule", "near", "far"), [("ink", 0.948, 0.802), ("mass", 1.0, 0.85)])
def test_two_discs_are_as_opaque_as_they_look(rule, near, far):
    """One and two standard deviations apart; the ink is what the integral over the plane gives."""
    assert float(merge_groups(rounds(2, 0.6, 1.0), rule=rule).opacities) == pytest.approx(near, abs=0.01)
    assert float(merge_groups(rounds(2, 0.6, 2.0), rule=rule).opacities) == pytest.approx(far, abs=0.01)


def test_ink_equals_the_integral_of_the_joint_opacity():
    pair = rounds(2, 0.6, 1.0)
    x = np.linspace(-8, 9, 1701)
    xx, yy = np.meshgrid(x, x)
    one, two = (0.6 * np.exp(-((xx - at) ** 2 + yy**2) / 2) for at in (0, 1))
    ink = (1 - (1 - one) * (1 - two)).sum() * (x[1] - x[0]) ** 2
    found = merge_groups(pair)
    area = 2 * math.pi * float(found.scales[0].sort().values[1:].prod())
    assert float(found.opacities) * area == pytest.approx(ink, rel=1e-6)


def test_equal_gaussians_at_one_place_keep_their_shape_and_add_their_ink():
    found = merge_groups(rounds(2, 0.4))
    assert torch.allclose(found.scales.sort(1).values[0], torch.tensor([0.01, 1, 1], dtype=torch.float64), atol=1e-9)
    assert float(found.opacities) == pytest.approx(2 * 0.4 - 0.4**2 / 2)


def test_six_coincident_opaque_ones_stay_opaque():
    assert float(merge_groups(rounds(6, 1.0)).opacities) == 1.0


@pytest.mark.parametrize("rule", ["ink", "mass"])
def test_widened_ones_keep_what_opacity_one_cannot_hold(rule):
    groups = rounds(2, 1.0)
    cut, wide = (merge_groups(groups, rule=rule, widen=widen) for widen in (False, True))
    excess = 1.5 if rule == "ink" else 2.0
    assert float(wide.opacities) == float(cut.opacities) == 1.0
    assert torch.allclose(wide.scales, cut.scales * math.sqrt(excess), rtol=1e-12)
    assert float(surface(wide.scales)) == pytest.approx(float(excess * surface(cut.scales)), rel=1e-12)


def test_the_order_of_the_members_does_not_matter():
    groups = random_splats(20, 4)
    turned = Splats(*(values.flip(1) for values in groups))
    for one, other in zip(merge_groups(groups), merge_groups(turned), strict=True):
        assert torch.allclose(one.abs(), other.abs(), atol=1e-9)  # an axis may point either way


def test_turning_and_scaling_commute_with_merging():
    groups = random_splats(20, 2)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    axes = torch.stack([torch.eye(3, dtype=torch.float64)] * 1) @ turn
    q = quaternions(axes)[0]

    def times(p):
        w, x, y, z = q
        matrix = torch.stack([torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]),
                              torch.stack([y, z, w, -x]), torch.stack([z, -y, x, w])])  # fmt: skip
        return p @ matrix.T

    moved = groups._replace(means=3 * groups.means @ turn.T + 5, scales=3 * groups.scales, quats=times(groups.quats))
    found, expected = merge_groups(moved), merge_groups(groups)
    assert torch.allclose(found.means, 3 * expected.means @ turn.T + 5, atol=1e-9)
    assert torch.allclose(covariance(found), 9 * turn @ covariance(expected) @ turn.T, atol=1e-9)
    assert torch.allclose(found.opacities, expected.opacities, atol=1e-9)


@pytest.mark.parametrize("scales", [(1e-30, 1e-30, 1e-30), (1e15, 1e15, 1e15), (1, 1, 0), (1, 0, 0), (1e15, 1e-30, 1)])
@pytest.mark.parametrize("alpha", [0.0, 1e-6, 1.0])
def test_no_shape_gives_nonsense(scales, alpha):
    groups = rounds(3, alpha, 1e-3)._replace(scales=torch.tensor(scales, dtype=torch.float64).expand(1, 3, 3))
    for values in merge_groups(groups, widen=True):
        assert bool(torch.isfinite(values).all())


def by_quadrature(pair: Splats, merged: Splats) -> float:
    """Squared difference of opacity times colour times the Gaussians, summed over a grid."""
    x = np.linspace(-9, 9, 121)
    grid = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1)

    def field(mean, cov, alpha, sh):
        d = grid - mean
        value = np.exp(-0.5 * np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d))
        return float(alpha) * value[..., None] * (0.5 + 0.28209479177387814 * sh[0])

    def of(splats, i):
        return field(splats.means[i].numpy(), covariance(splats)[i].numpy(), splats.opacities[i], splats.sh[i].numpy())

    gone = of(pair, 0) + of(pair, 1) - of(merged, 0)
    return float((gone**2).sum() * (x[1] - x[0]) ** 3)


def test_the_price_is_the_integral_and_its_opacity_that_of_the_merged():
    group = random_splats(1, 2, seed=3)
    pair = Splats(*(values[0] for values in group))._replace(sh=group.sh[0, :, :1])
    merged = merge_groups(Splats(*(values[None] for values in pair)))
    columns = columns_of(pair, 1.0)
    price = float(prices(columns.part(0, 1), columns.part(1, 2)))
    colors = 0.5 + 0.28209479177387814 * pair.sh[:, 0]
    texture = 4 * math.pi * 1e-6 * float(((colors[0] - colors[1]) ** 2).sum())
    assert price - texture == pytest.approx(by_quadrature(pair, merged), rel=1e-4)  # of a grid 0.15 wide


def test_prices_do_not_depend_on_the_unit():
    groups = random_splats(1, 40, seed=4)
    splats = Splats(*(values[0] for values in groups))
    large = splats._replace(means=1e3 * splats.means, scales=1e3 * splats.scales)
    found = [prices(c.part(0, 39), c.part(1, 40)) for c in (columns_of(splats, 2.0), columns_of(large, 2e3))]
    assert torch.allclose(*found, rtol=1e-10)
    assert bool((found[0] >= 0).all())


def test_closeness_is_the_mahalanobis_distance():
    groups = random_splats(1, 2, seed=5)
    splats = Splats(*(values[0] for values in groups))
    columns = columns_of(splats, 1.0)
    d = (splats.means[1] - splats.means[0]).numpy()
    expected = d @ np.linalg.inv(covariance(splats).sum(0).numpy()) @ d
    assert float(closeness(columns.part(0, 1), columns.part(1, 2))) == pytest.approx(expected, rel=1e-9)


def model_of_points(points: torch.Tensor, scale: float = 0.1, alpha: float = 0.5) -> GaussianModel:
    n = len(points)
    return GaussianModel.from_tensors(
        points, torch.randn(n, 1, 3, generator=torch.Generator().manual_seed(7)), torch.zeros(n, 3, 3),
        torch.logit(torch.full((n,), alpha)),
        torch.full((n, 3), math.log(scale)), torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
    )  # fmt: skip


def test_neighbours_merge_and_the_far_one_stays():
    points = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [3, 0, 0], [3.05, 0, 0], [9, 9, 9]])
    found = merged_to(model_of_points(points), 3)
    assert found.num_rows == 3
    assert torch.allclose(found.means[:, 0].sort().values, torch.tensor([0.025, 3.025, 9.0]), atol=1e-5)


@pytest.mark.parametrize("points", [torch.zeros(300, 3), torch.rand(300, 3, generator=torch.Generator().manual_seed(0)),
                                    1e6 * torch.eye(3)[torch.arange(300) % 3]])  # fmt: skip
def test_any_count_is_reached(points):
    for count in (299, 100, 1):
        assert merged_to(model_of_points(points), count).num_rows == count


def test_the_order_of_merges_is_the_same_in_any_unit():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    small = merged_to(model_of_points(points), 100)
    large = merged_to(model_of_points(16 * points, 1.6), 100)  # a power of two: float32 rounds alike
    assert torch.allclose(16 * small.means, large.means, rtol=1e-3)


def test_significant_ones_stay_as_they_are():
    points = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [3, 0, 0], [3.06, 0, 0]])
    found = merged_to(model_of_points(points), 3, significance=torch.tensor([1e6, 1e6, 1.0, 1.0]))
    assert torch.allclose(found.means[:, 0].sort().values, torch.tensor([0.0, 0.05, 3.03]), atol=1e-5)


def test_levels_halve_down_to_a_64th_or_20_000():
    assert level_counts(1_000_000) == [1_000_000, 500_000, 250_000, 125_000, 62_500, 31_250]
    assert level_counts(10_000_000)[-1] == 156_250
    assert level_counts(30_000) == [30_000]
    assert level_counts(9, 3) == [9, 5, 3]


@pytest.mark.parametrize("bands", [0, 3, 15])
@pytest.mark.parametrize("count", [0, 1, 20, 60, 99, 100])
def test_coefficients_of_some_rows_are_theirs_wherever_they_lie(monkeypatch, bands: int, count: int):
    monkeypatch.setattr(merging, "ROWS_AT_ONCE", 7)
    random = torch.Generator().manual_seed(0)
    sh, rows = torch.randn(100, 1 + bands, 3, generator=random), torch.randperm(100, generator=random)[:count]
    dc, rest = merging.sh_of(sh.clone(), rows)
    assert torch.equal(dc, sh[rows, :1])
    assert torch.equal(rest, sh[rows, 1:])
    assert rest.is_contiguous()


@pytest.mark.parametrize("bands", [1, 4])
@pytest.mark.parametrize("weighted", [False, True])
def test_native_partners_are_those_of_the_plain_version(bands, weighted):
    if not GAUSSIANS.try_load():
        pytest.skip("no compiled kernels")
    splats = Splats(*(each[:, 0].float() for each in random_splats(3000, 1)))
    splats = splats._replace(
        sh=splats.sh[:, :bands].contiguous(), opacities=splats.opacities * (torch.arange(3000) > 5)
    )
    weights = torch.rand(3000, generator=torch.Generator().manual_seed(1)) if weighted else None
    pool = simplifying._Pool.of(splats, weights)
    pool.order = pool.order[::2].contiguous()
    (plain, theirs), (native, ours) = (
        find(pool, 4.0, 2) for find in (simplifying._partners, simplifying._native_partners)
    )
    assert torch.equal(plain.isinf(), native.isinf())
    assert (theirs == ours).float().mean() > 0.995  # float32: prices that are nearly equal
    there = plain.isfinite()
    close = torch.isclose(native[there], plain[there], rtol=0.01, atol=1e-6)
    assert close.float().mean() > 0.99  # float32 of either is some percent off for few
    assert int(plain.isinf().sum()) < 1450


@pytest.mark.parametrize("widen", [False, True])
def test_native_merging_is_that_of_the_plain_version(widen):
    if not GAUSSIANS.try_load():
        pytest.skip("no compiled kernels")
    splats = Splats(*(each[:, 0].float() for each in random_splats(600, 1)))
    scales, opacities = splats.scales.clone(), splats.opacities.clone()
    scales[:20, 2], scales[20:40, 1:], scales[40:50], scales[50:60] = 1e-9, 1e-4, 1e-9, 1e3
    opacities[::7], opacities[60:80] = 0, 1
    quats = splats.quats * torch.linspace(0.5, 2, 600)[:, None]
    splats = splats._replace(scales=scales, opacities=opacities, quats=quats)
    splats.means[40:50], splats.means[80:120] = splats.means[40].clone(), splats.means[80].clone()
    pairs = torch.arange(600).view(300, 2)
    plain, native = (simplifying._Pool.of(Splats(*(each.clone() for each in splats)), None) for _ in range(2))
    simplifying._merge(plain, pairs, widen)
    simplifying._native_merge(native, pairs, widen)
    assert torch.allclose(plain.splats.means, native.splats.means, rtol=1e-6)
    assert torch.allclose(plain.splats.opacities, native.splats.opacities, rtol=1e-5)
    sizes = plain.splats.scales.amax(dim=1, keepdim=True)  # float64 knows variances to 1e-16 of the largest
    assert torch.allclose(plain.splats.scales / sizes, native.splats.scales / sizes, atol=1e-7)
    assert torch.allclose(plain.splats.sh, native.splats.sh, atol=1e-6)
    # Of axes that are equally long any two do, so it is their covariances that are equal.
    shapes = [pool.table[:, 3:9] * (pool.unit / sizes) ** 2 for pool in (plain, native)]
    assert torch.allclose(*shapes, atol=1e-6)
    others = [0, 1, 2, *range(9, 15)]
    assert torch.allclose(plain.table[:, others], native.table[:, others], rtol=1e-4, atol=1e-6)


def test_a_window_that_is_none_is_refused():
    if not GAUSSIANS.try_load():
        pytest.skip("no compiled kernels")
    with pytest.raises(RuntimeError, match="a window of 0"):
        merge_partners(torch.arange(2), 0)


def test_a_row_that_is_not_there_is_refused():
    if not GAUSSIANS.try_load():
        pytest.skip("no compiled kernels")
    with pytest.raises(RuntimeError, match="row 2 of 2"):
        merge_partners(torch.arange(1, 3), 8)


def test_a_pair_that_is_not_there_is_refused():
    if not GAUSSIANS.try_load():
        pytest.skip("no compiled kernels")
    with pytest.raises(RuntimeError, match="row 2 of 2"):
        face.merge_pairs(
            means=torch.zeros(2, 3), scales=torch.ones(2, 3), quats=torch.ones(2, 4), opacities=torch.ones(2),
            sh=torch.zeros(2, 3), table=torch.zeros(2, 15), pairs=torch.tensor([[0, 2]]), unit=1.0,
            center=torch.zeros(3), widen=0,
        )  # fmt: skip


def merge_partners(order: torch.Tensor, window: int) -> None:
    """Among two rows of zeros."""
    face.merge_partners(
        table=torch.zeros(2, 15), sh=torch.zeros(2, 3), weights=None, order=order, window=window, wave=0, near=4.0,
        prices=torch.zeros(2, window), best=torch.zeros(2), partner=torch.zeros(2, dtype=torch.int64),
    )  # fmt: skip


def test_merged_gaussians_may_grow_where_opacity_does_not_suffice():
    rng = torch.Generator().manual_seed(3)
    means = torch.rand(400, 3, generator=rng)
    opaque = GaussianModel.from_tensors(
        means, torch.zeros(400, 1, 3), torch.zeros(400, 0, 3), torch.full((400,), 6.0), torch.full((400, 3), -3.0),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(400, 1),
    )  # fmt: skip
    cut, grown = (merged_to(opaque, 100, widen=widen) for widen in (False, True))
    assert float(grown.scales.mean()) > 1.05 * float(cut.scales.mean())
