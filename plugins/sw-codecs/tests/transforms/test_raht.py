"""RAHT: hand-computed coefficients, an orthonormal transform and its inverse, gradients."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import ShapeError
from sw_codecs.positions import morton
from sw_codecs.transforms.raht import RahtPlan


def codes_of(n, bits, seed=0):
    points = np.random.default_rng(seed).integers(0, 1 << bits, (n, 3))
    return np.unique(morton.encode(points))


def values_of(m, columns=7, dtype=torch.float64, seed=0):
    return torch.randn(m, columns, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def by_levels(codes, values):
    """The transform as its definition has it: every bit, node by node."""
    nodes = [(int(code), 1, row, values[row].clone()) for row, code in enumerate(codes)]
    found = values.clone()
    while len(nodes) > 1:
        merged, i = [], 0
        while i < len(nodes):
            if i + 1 < len(nodes) and nodes[i][0] >> 1 == nodes[i + 1][0] >> 1:
                (code, w, row, c), (_, v, right, d) = nodes[i : i + 2]
                found[right] = (-(v**0.5) * c + w**0.5 * d) / (w + v) ** 0.5
                merged.append((code >> 1, w + v, row, (w**0.5 * c + v**0.5 * d) / (w + v) ** 0.5))
                i += 2
            else:
                code, w, row, c = nodes[i]
                merged.append((code >> 1, w, row, c))
                i += 1
        nodes = merged
    found[0] = nodes[0][3]
    return found


def test_two_leaves():
    found = RahtPlan([0, 1]).forward(torch.tensor([[3.0], [5.0]]))
    assert found[:, 0].tolist() == pytest.approx([8 / 2**0.5, 2 / 2**0.5])


def test_three_leaves_of_weights_two_and_one():
    """Codes 0 and 1 merge first, their node (two leaves) with code 2 (one leaf) next."""
    found = RahtPlan([0, 1, 2]).forward(torch.tensor([[1.0], [2.0], [6.0]]))
    low = 3 / 2**0.5
    expected = [9 / 3**0.5, 1 / 2**0.5, (-low + 2**0.5 * 6) / 3**0.5]
    assert found[:, 0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("bits", [1, 2, 8, 21])
def test_the_plan_is_that_of_the_definition(bits):
    codes = codes_of(60, bits)
    values = values_of(len(codes))
    found = RahtPlan(codes).forward(values)
    assert torch.allclose(found, by_levels(codes, values), atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.sets(st.integers(0, 2**63 - 1), min_size=1, max_size=80))
def test_inverse_undoes_forward_and_energy_stays(codes):
    plan = RahtPlan(np.array(sorted(codes), np.int64))
    values = values_of(plan.size, dtype=torch.float32)
    found = plan.forward(values)
    assert torch.allclose(plan.inverse(found), values, atol=1e-5)  # float32, at most 63 levels
    assert float(found.square().sum()) == pytest.approx(float(values.square().sum()), rel=1e-5)
    assert torch.allclose(found[0], values.sum(0) / plan.size**0.5, atol=1e-4)


def test_a_constant_column_has_no_detail():
    codes = codes_of(500, 6)
    found = RahtPlan(codes).forward(torch.full((len(codes), 2), 3.5, dtype=torch.float64))
    assert float(found[1:].abs().max()) < 1e-13
    assert found[0].tolist() == pytest.approx([3.5 * len(codes) ** 0.5] * 2)


@pytest.mark.parametrize("direction", ["forward", "inverse"])
def test_gradients(direction):
    plan = RahtPlan(codes_of(9, 2))
    values = values_of(plan.size, 2).requires_grad_()
    assert torch.autograd.gradcheck(getattr(plan, direction), (values,))


def test_the_input_stays_as_it_is():
    plan, values = RahtPlan([0, 3, 5]), values_of(3)
    given = values.clone()
    plan.forward(values)
    plan.inverse(values)
    assert torch.equal(values, given)


def test_hardly_any_voxels():
    assert RahtPlan(np.zeros(0, np.int64)).forward(values_of(0)).shape == (0, 7)
    values = values_of(1)
    assert torch.equal(RahtPlan([5]).inverse(values), values)


@pytest.mark.parametrize("codes", [[1, 1], [2, 1], [-1, 4], [0.5], [[0, 1]]])
def test_codes_that_are_no_set_in_order_are_refused(codes):
    with pytest.raises(ValueError, match="codes must be"):
        RahtPlan(codes)


def test_rows_of_other_voxels_are_refused():
    with pytest.raises(ShapeError, match="over 2 voxels"):
        RahtPlan([0, 1]).forward(values_of(3))


@pytest.mark.cuda
def test_a_gpu_computes_the_same():
    plan = RahtPlan(codes_of(5000, 9))
    values = values_of(plan.size)
    assert torch.allclose(plan.forward(values.cuda()).cpu(), plan.forward(values), atol=1e-12)
    assert torch.allclose(plan.inverse(plan.forward(values.cuda())).cpu(), values, atol=1e-12)
