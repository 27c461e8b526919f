"""Affine fake quantization: observed ranges, zero point, gradient, blocks, exact integers."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError, ShapeError
from sw_codecs.quantizers.fake_quant import FakeQuantAffine


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def frozen(quantizer, x):
    quantizer.observe(x)
    quantizer.observing = False
    return quantizer


def test_by_hand():
    q = FakeQuantAffine(2)  # range -1 .. 2: s = 1, z = 1, q in 0 .. 3
    frozen(q, torch.tensor([-1.0, 2.0]))
    x = torch.tensor([-1.6, -1.4, 0.4, 0.6, 2.4, 2.6], requires_grad=True)
    out = q.forward(x)
    assert out.tolist() == [-1, -1, 0, 1, 2, 2]
    out.sum().backward()
    assert x.grad.tolist() == [0, 1, 1, 1, 1, 0]  # round(x / s) + z in 0 .. 3
    symbols, side = q.encode(x.detach())
    assert symbols.tolist() == [0, 0, 1, 2, 3, 3]
    assert (side["scale"].tolist(), side["zero"].tolist(), int(side["bits"])) == ([[1.0]], [[1]], 2)


def test_the_formula_of_the_library():
    x = torch.randn(1000, generator=gen())
    q = frozen(FakeQuantAffine(8), x)
    s = (x.max() - x.min()) / 255
    z = torch.round(-x.min() / s)
    assert torch.equal(q.forward(x), s * ((torch.round(x / s) + z).clamp(0, 255) - z))


def test_running_range_only_widens_and_ema_follows():
    running, ema = FakeQuantAffine(), FakeQuantAffine(ema=0.99)
    for low, high in ((-1.0, 1.0), (-3.0, 0.5), (-2.0, 4.0)):
        for q in (running, ema):
            q.forward(torch.tensor([low, high]))
    assert (float(running.minimum), float(running.maximum)) == (-3, 4)
    low, high = 0.99 * (0.99 * -1 + 0.01 * -3) + 0.01 * -2, 0.99 * (0.99 * 1 + 0.01 * 0.5) + 0.01 * 4
    assert float(ema.minimum) == pytest.approx(low, rel=1e-6)
    assert float(ema.maximum) == pytest.approx(high, rel=1e-6)


def test_a_frozen_range_stays_and_encoding_never_observes():
    q = frozen(FakeQuantAffine(), torch.tensor([-1.0, 1.0]))
    q.forward(torch.tensor([100.0]))
    q.encode(torch.tensor([100.0]))
    q.observing = True
    q.eval().forward(torch.tensor([100.0]))
    assert (float(q.minimum), float(q.maximum)) == (-1, 1)
    q.train().forward(torch.tensor([100.0]))
    assert float(q.maximum) == 100
    q.reset()
    assert not torch.isfinite(q.minimum).any()
    symbols, side = q.encode(torch.tensor([0.0, 2.0]))  # nothing observed: the range of what is encoded
    assert q.decode(symbols, side).tolist() == [0, 2]
    assert not torch.isfinite(q.minimum).any()


def test_zero_is_always_exact():
    x = torch.rand(100, generator=gen()) + 5
    for data in (x, -x):
        q = FakeQuantAffine(4)
        q.forward(data)
        q.observing = False
        assert float(q.forward(torch.zeros(1))) == 0
    near = FakeQuantAffine(4, zero=False)  # the rounded zero point shifts its range by up to half a step
    assert (near.forward(x) - x).abs().max() <= 1.01 * (x.max() - x.min()) / 15


def test_columns_and_blocks_have_ranges_of_their_own():
    x = torch.cat([torch.rand(4, 2, generator=gen()), 100 * torch.rand(3, 2, generator=gen(1))])
    x[:, 1] *= -10
    q = FakeQuantAffine(8, channels=2, blocks=2)  # rows 0..3 and 4..6
    out = q.forward(x)
    assert torch.equal(q.minimum, torch.stack([x[:4].amin(0), x[4:].amin(0)]))
    assert torch.equal(q.maximum, torch.stack([x[:4].amax(0), x[4:].amax(0)]))
    for part in (slice(0, 4), slice(4, 7)):
        for c in range(2):
            assert torch.equal(out[part, c], FakeQuantAffine(8).forward(x[part, c]))
    assert torch.equal(q.decode(*q.encode(x)), out)
    rows = FakeQuantAffine(8, blocks=2).forward(x[:, 0])
    assert torch.equal(rows, out[:, 0])


def test_more_blocks_than_rows_and_no_rows():
    x = torch.tensor([[1.0], [-2.0]])
    q = FakeQuantAffine(8, channels=1, blocks=5)
    assert torch.allclose(q.forward(x), x)
    symbols, side = q.encode(x)
    assert torch.allclose(q.decode(symbols, side), x)
    symbols, side = FakeQuantAffine(8, channels=3).encode(torch.empty(0, 3))
    assert FakeQuantAffine.decode(symbols, side).shape == (0, 3)
    assert FakeQuantAffine().forward(torch.empty(0)).shape == (0,)


def test_state_goes_through_a_checkpoint():
    x = torch.randn(50, 3, generator=gen())
    q = FakeQuantAffine(6, channels=3, ema=0.9)
    q.forward(x)
    q.forward(2 * x)
    again = FakeQuantAffine(6, channels=3, ema=0.9)
    again.load_state_dict(q.state_dict())
    assert torch.equal(again.forward(x), q.forward(x))


@settings(max_examples=80, deadline=None)
@given(
    st.integers(1, 16), st.integers(0, 20), st.integers(1, 3), st.integers(1, 4), st.integers(0, 2**31),
    st.floats(1e-4, 1e4), st.floats(-3, 3), st.booleans(),
)  # fmt: skip
def test_encode_of_decode_is_the_same(bits, n, channels, blocks, seed, spread, offset, zero):
    x = (torch.randn(n, channels, generator=gen(seed)) + offset) * spread
    q = FakeQuantAffine(bits, channels=channels, blocks=blocks, zero=zero)
    out = q.forward(x)
    q.observing = False
    symbols, side = q.encode(x)
    decoded = FakeQuantAffine.decode(symbols, side)
    assert torch.equal(decoded, out)
    assert torch.equal(q.encode(decoded)[0], symbols)
    if zero and n:
        step = torch.from_numpy(side["scale"]).amax(0)
        assert ((decoded - x).abs() <= 1.001 * step + 1e-6 * spread).all()  # half a step, half for the zero point


def test_a_narrow_range_far_from_zero_keeps_what_float32_can():
    q = FakeQuantAffine(16, zero=False)
    for x in (torch.tensor([1000.0, 1000.001, 1000.0004]), torch.full((3,), -7.25), torch.zeros(3)):
        symbols, side = q.encode(x)
        assert (q.decode(symbols, side) - x).abs().max() <= x.abs().max() / 2**20
        assert torch.equal(q.encode(q.decode(symbols, side))[0], symbols)


def test_values_and_ranges_that_are_not_finite_are_refused():
    q = FakeQuantAffine(16)
    with pytest.raises(ValueError, match="finite"):
        q.encode(torch.tensor([float("nan")]))
    with pytest.raises(ValueError, match="finite"):
        q.encode(torch.tensor([-3e38, 3e38]))


def test_wrong_use_is_refused():
    for wrong in ({"bits": 0}, {"bits": 17}, {"blocks": 0}, {"ema": 1.0}):
        with pytest.raises(ValueError, match="bits"):
            FakeQuantAffine(**wrong)
    with pytest.raises(ShapeError):
        FakeQuantAffine(channels=3).forward(torch.zeros(4, 2))


def test_hostile_side_information_is_refused():
    x = torch.randn(10, 2, generator=gen())
    symbols, side = FakeQuantAffine(4, channels=2).encode(x)
    for key, value in (
        ("scale", None), ("scale", side["scale"][0]), ("scale", side["scale"][:0]), ("scale", side["scale"] * 0),
        ("scale", side["scale"] * np.float32(np.nan)), ("scale", np.ones((1, 3), np.float32)), ("scale", "x"),
        ("scale", np.full((1, 2), 1e300)), ("scale", np.full((1, 2), 1e-300)), ("zero", side["zero"] + (1 << 21)),
        ("zero", side["zero"].astype(float)), ("zero", None), ("bits", np.uint8(0)), ("bits", np.uint8(17)),
        ("bits", None), ("bits", np.array([4], np.uint8)), ("bits", np.uint8(1)),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            FakeQuantAffine.decode(symbols, {**side, key: value})
    for bad in (symbols + 16, symbols - 16, symbols.float(), symbols[:, 0], symbols[:, :1]):
        with pytest.raises(BitstreamError):
            FakeQuantAffine.decode(bad, side)
