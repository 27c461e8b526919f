"""Rows under predicted distributions: exact on any machine, or in floats on this one."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.entropy.conditional import ConditionalGaussian

C = ConditionalGaussian


def block(n=300, columns=7, seed=0, mode="exact"):
    """Symbols that follow their distributions, with one far outlier."""
    rng = np.random.default_rng(seed)
    step = rng.uniform(0.1, 1.9, (n, 1))
    mean, scale = rng.normal(0, 20, (n, columns)), rng.uniform(0.05, 8, (n, columns))
    symbols = np.rint((mean + scale * rng.normal(size=(n, columns))) / step).astype(np.int64)
    if symbols.size:
        symbols[0, 0] += 9000
    if mode == "exact":
        mean, scale, step = (np.rint(each * 4096).astype(np.int64) for each in (mean, scale, step))
    return symbols, C.Context(mean, scale, step)


@pytest.mark.parametrize("mode", C.MODES)
@pytest.mark.parametrize("shape", [(300, 7), (1, 1), (0, 7), (5, 0)])
def test_a_block_comes_back(mode, shape):
    symbols, context = block(*shape, mode=mode)
    codec = C(mode)
    present = np.random.default_rng(1).random(shape) < 0.6
    assert np.array_equal(C(mode).decode(codec.encode(symbols, context), context), symbols)
    data = codec.encode(symbols, context, present)
    assert np.array_equal(C(mode).decode(data, context, present), symbols * present)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("mode", C.MODES)
@pytest.mark.parametrize("shape", [(300, 7), (1, 1), (0, 7)])
def test_values_are_written_into_their_place(mode, shape, compiled, kernels):
    kernels(compiled)
    symbols, context = block(*shape, mode=mode)
    there = torch.from_numpy(np.random.default_rng(1).random(shape) < 0.6)
    step = torch.rand(shape[0], 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.01
    whole = torch.full((shape[0], shape[1] + 2), -7.0)
    for present in (None, there):
        data = C(mode).encode(symbols, context, present)
        found = C(mode).decode_into(whole[:, 1:-1], data, context, step, present)
        expected = torch.from_numpy(symbols if present is None else symbols * there.numpy())
        assert torch.equal(found, expected)
        assert torch.equal(whole[:, 1:-1], (expected * step).to(torch.float32))
        assert bool((whole[:, [0, -1]] == -7).all())


@pytest.mark.parametrize("compiled", [True, False])
def test_parameters_of_rows_are_spread_over_them(compiled, kernels):
    kernels(compiled)
    symbols, context = block()
    scale, wide = context.scale[:, :1], np.broadcast_to(context.scale[:, :1], symbols.shape)
    narrow, full = (C.Context(context.mean, each, context.step) for each in (scale, wide))
    data = C().encode(symbols, full)
    assert C().encode(symbols, narrow) == data
    assert np.array_equal(C().decode(data, narrow), symbols)
    assert torch.equal(C().bits(symbols, narrow), C().bits(symbols, full))


@pytest.mark.parametrize("mode", C.MODES)
def test_nothing_present_costs_nothing_but_the_frame(mode):
    symbols, context = block(mode=mode)
    nothing = np.zeros(symbols.shape, bool)
    data = C(mode).encode(symbols, context, nothing)
    assert len(data) <= 6
    assert not C(mode).decode(data, context, nothing).any()


@pytest.mark.parametrize("mode", C.MODES)
def test_the_estimate_is_the_size(mode):
    symbols, context = block(4000, 30, mode=mode)
    codec = C(mode)
    present = np.random.default_rng(1).random(symbols.shape) < 0.8
    bits = codec.bits(symbols, context, present)
    assert bits.shape == symbols.shape
    assert 8 * len(codec.encode(symbols, context, present)) == pytest.approx(
        float(bits.sum()), rel=2e-3 if mode == "exact" else 0.01
    )


def test_both_modes_cost_about_the_same():
    symbols, exact = block(4000, 30)
    _, floats = block(4000, 30, mode="float")
    sizes = len(C("exact").encode(symbols, exact)), len(C("float").encode(symbols, floats))
    # The outlier widens the domain of the float mode, where each symbol takes at least 2^-24.
    assert sizes[0] == pytest.approx(sizes[1], rel=0.02)


@pytest.mark.parametrize("mode", C.MODES)
def test_another_context_is_noticed(mode):
    symbols, context = block(mode=mode)
    data = C(mode).encode(symbols, context)
    # Half a step further: many tables are others, whatever the lattice of the mode rounds to.
    moved = C.Context(context.mean + context.step // 2 + 1, context.scale, context.step)
    with pytest.raises(BitstreamError):
        C(mode).decode(data, moved)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(C.MODES), st.integers(0, 2**32 - 1), st.integers(0, 255), st.booleans())
@example("exact", 87, 1, False)  # of the last word of a range coder not every bit says something
def test_damage_is_answered_or_changes_nothing(mode, place, value, cut):
    symbols, context = block(40, 3, mode=mode)
    data = bytearray(C(mode).encode(symbols, context))
    at = place % len(data)
    if cut:
        data = data[:at]
    else:
        data[at] ^= value or 1
    try:
        found = C(mode).decode(bytes(data), context)
    except BitstreamError:
        return
    assert not cut
    assert np.array_equal(found, symbols)


@pytest.mark.parametrize("mode", C.MODES)
def test_parameters_that_are_not_finite_are_refused(mode):
    symbols, context = block(mode=mode)
    if mode == "float":
        context.mean[3, 2] = np.nan
    else:
        context.mean[3, 2] = 1 << 60
    with pytest.raises(ValueError):
        C(mode).encode(symbols, context)


def test_multipliers_of_either_method():
    t = np.array([-(1 << 20), -3840, 256, 4352, 1 << 20])  # the middles of steps of 1/8
    hac = C.step_multipliers(t)
    assert hac.tolist() == [64, *np.rint(4096 * (1 + np.tanh(t[1:4] / 4096))), 8192]
    assert (C.step_multipliers(t, offset=410) - hac == 410).all()


def test_blocks_cover_all_rows_and_join_and_split():
    assert C.blocks(0, 50) == []
    cut = C.blocks(50_000, 50)
    assert [cut[0].start, cut[-1].stop] == [0, 50_000]
    assert all((part.stop - part.start) * 50 <= 1 << 20 for part in cut)
    parts = [b"", b"abc", bytes(300)]
    assert list(C.split(C.join(parts), 3)) == parts
    for wrong in (2, 4):
        with pytest.raises(BitstreamError):
            list(C.split(C.join(parts), wrong))


def test_an_unknown_mode_is_named():
    with pytest.raises(ValueError, match="mode is 'fast'"):
        C("fast")
