"""Learned step size: forward, both gradients with their scale, start, exact integers."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError, ShapeError
from sw_codecs.lsq import Lsq


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def test_by_hand():
    q = Lsq(3, step=0.5)  # k in -4 .. 3
    x = torch.tensor([0.7, -0.3, 1.6, 5.0, -5.0], requires_grad=True)
    out = q.forward(x)
    assert out.tolist() == [0.5, -0.5, 1.5, 1.5, -2.0]
    out.sum().backward()
    assert x.grad.tolist() == [1, 1, 1, 0, 0]
    inside = (1 - 1.4) + (-1 + 0.6) + (3 - 3.2)
    assert float(q.step.grad) == pytest.approx((inside + 3 - 4) / (5 * 3) ** 0.5, rel=1e-5)


def test_the_gradient_is_that_of_the_formula_with_rounding_passed_through():
    x = torch.randn(40, 3, generator=gen(), dtype=torch.float64) * 3
    q = Lsq(4, channels=3, step=0.4)
    weight = torch.randn(40, 3, generator=gen(1), dtype=torch.float64)
    (q.forward(x) * weight).sum().backward()
    step = torch.full((3,), 0.4, dtype=torch.float64, requires_grad=True)
    scaled = x / step
    rounded = scaled + (torch.round(scaled) - scaled).detach()
    ((torch.clamp(rounded, -8, 7) * step) * weight).sum().backward()
    assert torch.allclose(q.step.grad.double(), step.grad / (40 * 7) ** 0.5, rtol=1e-4, atol=1e-4)


def test_it_starts_at_the_size_of_the_data_and_learns():
    x = torch.randn(500, generator=gen())
    q = Lsq(3)
    q.forward(x)
    assert q.step.item() == pytest.approx(2 * float(x.abs().mean()) / 3**0.5, rel=1e-6)
    optimizer = torch.optim.Adam(q.parameters(), lr=0.01)
    errors = []
    for _ in range(150):
        optimizer.zero_grad()
        error = (q.forward(x) - x).square().mean()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert min(errors[-10:]) < 0.9 * errors[0]
    again = Lsq(3)
    again.load_state_dict(q.state_dict())
    assert torch.equal(again.forward(5 * x), q.forward(5 * x))  # a loaded step is not set anew


def test_a_step_that_an_optimizer_drove_below_zero_still_works():
    q = Lsq(4, step=0.5)
    with torch.no_grad():
        q.step.neg_()
    x = torch.randn(20, generator=gen())
    assert torch.equal(q.forward(x), Lsq(4, step=0.5).forward(x))
    with torch.no_grad():
        q.step.zero_()
    assert torch.isfinite(q.forward(x)).all()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 16), st.booleans(), st.booleans(), st.integers(0, 20), st.integers(0, 2**31), st.floats(1e-4, 1e4)
)
def test_encode_of_decode_is_the_same(bits, signed, per_channel, n, seed, spread):
    x = torch.randn(n, 2, generator=gen(seed)) * spread
    q = Lsq(bits, signed=signed, channels=2 if per_channel else None)
    symbols, side = q.encode(x)
    decoded = Lsq.decode(symbols, side)
    assert torch.equal(decoded, q.forward(x))
    assert torch.equal(q.encode(decoded)[0], symbols)
    if n:
        assert int(symbols.min()) >= (-(2 ** (bits - 1)) if signed else 0)
        assert int(symbols.max()) <= (2 ** (bits - 1) if signed else 2**bits) - 1


def test_wrong_use_is_refused():
    for wrong in ({"bits": 1}, {"bits": 17}, {"bits": 0, "signed": False}):
        with pytest.raises(ValueError, match="bits"):
            Lsq(**wrong)
    for step in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="step"):
            Lsq(step=step)
    with pytest.raises(ShapeError):
        Lsq(channels=3).forward(torch.zeros(4, 2))
    with pytest.raises(ValueError, match="finite"):
        Lsq().encode(torch.tensor([float("inf")]))


def test_hostile_side_information_is_refused():
    symbols, side = Lsq(4, channels=2).encode(torch.randn(10, 2, generator=gen()))
    for key, value in (
        ("step", None), ("step", side["step"][:1]), ("step", -side["step"]), ("step", side["step"] * np.nan),
        ("step", "x"), ("step", np.full(2, 1e300)), ("range", None), ("range", np.array([-8, 1 << 20])),
        ("range", np.array([-8])), ("range", np.array([0, 0])), ("range", np.array([-8.0, 7.0])),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            Lsq.decode(symbols, {**side, key: value})
    for bad in (symbols + 16, symbols - 16, symbols.float(), symbols[:, 0]):
        with pytest.raises(BitstreamError):
            Lsq.decode(bad, side)
