"""Positions on a grid: floor and rounding, boxes, parity with HAC's step, points that stay where they are."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError, ShapeError
from sw_codecs.position_grid import PositionQuantizer


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def test_by_hand():
    x = torch.tensor([[-1.0, 0.0], [0.9, 5.0], [1.9, 5.0], [9.0, 5.0]], requires_grad=True)
    q = PositionQuantizer(2, low=[0.0, 5.0], high=[3.0, 5.0])  # steps 1 and, for the flat axis, 1e-6
    symbols, side = q.encode(x)
    assert symbols.tolist() == [[0, 0], [0, 0], [1, 0], [3, 0]]
    assert side["step"].tolist() == [1.0, 1e-6]
    out = q.forward(x)
    assert out.tolist() == [[0, 5], [0, 5], [1, 5], [3, 5]]
    out.sum().backward()
    assert (x.grad == 1).all()
    rounded = PositionQuantizer(2, low=[0.0, 5.0], high=[3.0, 5.0], floor=False)
    assert rounded.encode(x)[0][:, 0].tolist() == [0, 1, 2, 3]


def test_floor_is_biased_by_half_a_step_and_rounding_is_not():
    x = torch.rand(20_000, 3, generator=gen())
    for floor, bias in ((True, -0.5), (False, 0.0)):
        q = PositionQuantizer(8, low=0.0, high=1.0, floor=floor)
        error = (q.forward(x) - x) * 255
        assert float(error.mean()) == pytest.approx(bias, abs=0.01)
        assert error.abs().max() <= (1 if floor else 0.5) + 1e-4


def test_the_measured_box_reaches_both_ends():
    x = torch.randn(500, 3, generator=gen()) * torch.tensor([1.0, 100.0, 0.01])
    symbols, side = PositionQuantizer(16).encode(x)
    assert symbols.amin(0).tolist() == [0, 0, 0]
    assert symbols.amax(0).tolist() == [65535] * 3
    decoded = PositionQuantizer.decode(symbols, side)
    assert torch.allclose(decoded.amax(0), x.amax(0), rtol=1e-6)
    assert torch.equal(decoded.amin(0), x.amin(0))


def test_normalized_coordinates_are_exact():
    q = PositionQuantizer(16, low=0.0, high=1.0)
    v = torch.arange(65536)[:, None].expand(-1, 3)
    assert torch.equal(q.normalized(v), v.double() / 65535)
    side = q.encode(torch.zeros(1, 3))[1]
    assert torch.equal(q.encode(q.decode(v, side))[0], v)  # every point of the grid is found again


def test_parity_with_the_step_of_the_authors_code():
    q = PositionQuantizer(16, low=-1.0, high=1.0, delta_eps=True)
    side = q.encode(torch.zeros(1, 3))[1]
    assert side["step"].tolist() == pytest.approx([2 / 65535 + 1e-6] * 3)
    flat = PositionQuantizer(16, low=2.0, high=2.0, delta_eps=True).encode(torch.zeros(1, 3))[1]
    assert flat["step"].tolist() == [1e-6] * 3


@settings(max_examples=100, deadline=None)
@given(
    st.integers(1, 16), st.integers(0, 30), st.integers(0, 2**31), st.floats(1e-3, 1e4), st.floats(-3, 3),
    st.booleans(), st.booleans(),
)  # fmt: skip
def test_encode_of_decode_is_the_same(bits, n, seed, spread, offset, floor, delta_eps):
    x = (torch.randn(n, 3, generator=gen(seed)) + offset) * spread
    low, high = (x.amin(0), x.amax(0)) if n else (0.0, 1.0)
    q = PositionQuantizer(bits, low=low, high=high, floor=floor, delta_eps=delta_eps)
    symbols, side = q.encode(x)
    decoded = PositionQuantizer.decode(symbols, side)
    assert torch.equal(decoded, q.forward(x))
    step = torch.from_numpy(side["step"])
    resolved = bool((step > 1e-6 * (x.abs().amax(0) if n else 1)).all())
    if resolved:  # else float32 does not hold the points of the grid apart
        assert torch.equal(q.encode(decoded)[0], symbols)
    assert torch.equal(q.decode(q.encode(decoded)[0], side), decoded)
    error = (x.double() - decoded.double()) / step
    assert (error <= (1 if floor else 0.5) + 1e-6 * spread / step).all()


def test_a_box_that_is_none_is_refused():
    x = torch.zeros(2, 3)
    for low, high in ((1.0, 0.0), (float("nan"), 1.0), (0.0, float("inf")), (0.0, 1e300)):
        with pytest.raises(ValueError, match="box"):
            PositionQuantizer(low=low, high=high).encode(x)
    with pytest.raises(ValueError, match="finite"):
        PositionQuantizer().encode(x * float("nan"))
    with pytest.raises(ShapeError):
        PositionQuantizer().encode(torch.zeros(5))
    for bits in (0, 22):
        with pytest.raises(ValueError, match="bits"):
            PositionQuantizer(bits)


def test_hostile_side_information_is_refused():
    symbols, side = PositionQuantizer(8).encode(torch.rand(10, 3, generator=gen()))
    for key, value in (
        ("low", None), ("low", side["low"][:2]), ("low", side["low"] * np.nan), ("step", -side["step"]),
        ("step", side["step"] * 0), ("step", np.full(3, np.inf)), ("step", np.full(3, 1e300)), ("step", "x"),
        ("bits", np.uint8(0)), ("bits", np.uint8(22)), ("bits", None), ("bits", np.float64(8)),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            PositionQuantizer.decode(symbols, {**side, key: value})
    for bad in (symbols + 256, symbols - 256, symbols.float(), symbols[:, 0], symbols[:, :2]):
        with pytest.raises(BitstreamError):
            PositionQuantizer.decode(bad, side)
