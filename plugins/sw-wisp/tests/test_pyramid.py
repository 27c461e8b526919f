import numpy as np
import pytest
import torch
from wisp_scenes import made_up

from sw_codecs.positions import morton
from sw_wisp.numbers import NUMBERS
from sw_wisp.packets import REFINED
from sw_wisp.pyramid import BASE, FEATURES, VALUE_LIMIT, VIEW, Pyramid

PRIOR = torch.arange(NUMBERS) * 160


def scene(n: int, seed: int = 0):
    """Levels, codes, and whole values and indices [n,22] of splats."""
    found = made_up(n, seed=seed)
    rng = np.random.default_rng(seed)
    values, indices = rng.integers(-(1 << 17), 1 << 17, (n, NUMBERS)), rng.integers(-40, 40, (n, NUMBERS))
    codes = torch.from_numpy(morton.encode(found.cells.numpy()))
    return found.levels, codes, torch.from_numpy(values), torch.from_numpy(indices)


def full(levels, codes, values, indices, rows=slice(None)) -> Pyramid:
    pyramid = Pyramid(PRIOR)
    pyramid.announce(levels, codes)
    at = torch.arange(len(levels))[rows]
    for part in (BASE, VIEW):
        pyramid.add(at, part, values[at, part], indices[at, part])
    return pyramid


def mean_by_hand(levels, codes, numbers, known, prior, level, cell) -> int:
    """The shrunk mean of one column in one cell, by its definition."""
    mean = prior
    for g in range(1, level + 1):
        inside = [
            (int(v), k)
            for at, code, v, k in zip(levels.tolist(), codes.tolist(), numbers.tolist(), known, strict=True)
            if at >= g and code >> 3 * (at - g) == cell >> 3 * (level - g)
        ]
        if len(inside) > 1:
            mean = (sum(v for v, k in inside if k) + 2 * mean) // (sum(bool(k) for _, k in inside) + 2)
    return mean


def test_features_by_their_definition():
    levels, codes, values, indices = scene(60)
    levels[:20], codes[:20] = 16, torch.arange(20) // 3  # crowds within few cells of the finest levels
    levels[20:30], codes[20:30] = 15, 0
    known = torch.arange(60) % 2 == 0
    found = full(levels, codes, values, indices, known).features(torch.arange(60))
    assert found.shape == (60, FEATURES)
    assert found.dtype == torch.int64
    activity = indices.abs().clamp_max(15) * 256
    for row in range(0, 60, 5):
        level = int(levels[row])
        wanted = []
        for g in (min(level, 15), max(level - 3, 0)):
            cell = int(codes[row]) >> 3 * (level - g)
            wanted += [mean_by_hand(levels, codes, values[:, c], known, int(PRIOR[c]), g, cell) for c in range(NUMBERS)]
        g = min(level - 1, 15)
        cell = int(codes[row]) >> 3 * (level - g)
        wanted += [mean_by_hand(levels, codes, activity[:, c], known, 256, g, cell) for c in range(NUMBERS)]
        wanted.append(256 * level)
        for g in (min(level, 15), max(level - 3, 0)):
            cell = int(codes[row]) >> 3 * (level - g)
            inside = (levels >= g) & (codes >> 3 * (levels - g).clamp_min(0) == cell)
            wanted.append(256 * min(int((inside & known).sum()), 15) if inside.sum() > 1 else 0)
        assert found[row].tolist() == wanted


def test_nothing_known_gives_the_prior():
    levels, codes, *_ = scene(30)
    pyramid = Pyramid(PRIOR)
    pyramid.announce(levels, codes)
    found = pyramid.features(torch.arange(30))
    assert (found[:, :NUMBERS] == PRIOR).all()
    assert (found[:, NUMBERS : 2 * NUMBERS] == PRIOR).all()
    assert (found[:, 2 * NUMBERS : 3 * NUMBERS] == 256).all()
    assert (found[:, -2:] == 0).all()


def test_order_of_rows_and_parts_changes_no_integer():
    levels, codes, values, indices = scene(3000)
    whole = full(levels, codes, values, indices).features(torch.arange(3000))
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(1))
    pyramid = Pyramid(PRIOR)
    for announced in torch.arange(3000).split(1000):
        pyramid.announce(levels[order[announced]], codes[order[announced]])
        for rows in announced.split(170):
            for part in (BASE, VIEW):
                pyramid.add(rows, part, values[order[rows], part], indices[order[rows], part])
    assert torch.equal(pyramid.features(torch.arange(3000)), whole[order])
    blocks = [pyramid.features(rows) for rows in torch.arange(3000).split(7)]
    assert torch.equal(torch.cat(blocks), whole[order])


def test_refinement_leaves_sums_of_the_fine_values_and_activity_of_the_coarse():
    levels, codes, values, indices = scene(500)
    rows = torch.arange(500)
    coarse = values.clone()
    coarse[:, REFINED] -= 3000
    pyramid = Pyramid(PRIOR)
    pyramid.announce(levels, codes)
    for part in (BASE, VIEW):
        pyramid.add(rows, part, coarse[:, part], indices[:, part])
    pyramid.refine(rows, REFINED, coarse[:, REFINED], values[:, REFINED])
    assert torch.equal(pyramid.features(rows), full(levels, codes, values, indices).features(rows))


@pytest.mark.parametrize("sign", [1, -1])
def test_sums_of_the_largest_values_stay_exact(sign):
    """2^21 times 2^20 and more in one cell: 2^26 rows of it still lie below 2^53."""
    n = 1 << 12
    pyramid = Pyramid(torch.zeros(NUMBERS, dtype=torch.int64))
    pyramid.announce(torch.full((n,), 3), torch.zeros(n, dtype=torch.int64))
    rows, values = torch.arange(n), torch.full((n, 10), sign << 34)
    pyramid.add(rows, BASE, values, values)
    assert (1 << 26) * VALUE_LIMIT < 1 << 53
    expected = 0
    for _ in range(3):
        expected = (sign * n * VALUE_LIMIT + 2 * expected) // (n + 2)
    assert (pyramid.features(rows[:1])[0, :10] == expected).all()


def test_an_empty_subset_is_fine():
    pyramid = Pyramid(PRIOR)
    none = torch.empty(0, dtype=torch.int64)
    pyramid.announce(none, none)
    pyramid.add(none, BASE, torch.empty(0, 10), torch.empty(0, 10))
    assert pyramid.features(none).shape == (0, FEATURES)
