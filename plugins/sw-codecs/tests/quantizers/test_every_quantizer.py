"""Every quantizer of ours: a file's symbols and side information suffice, on a fresh object."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from sw_codecs.testing import check_quantizer

QUANTIZERS = load_plugins().quantizers
NAMES = [entry.name for entry in QUANTIZERS if is_ours(entry.distribution)]
FITTED = {"vq", "residual-vq"}
NOT_IDEMPOTENT = {"residual-vq"}  # greedy: a decoded row may be encoded otherwise, see its docstring


def made(name, x):
    if name not in FITTED:
        return QUANTIZERS.load(name)()
    quantizer = QUANTIZERS.load(name)(4)
    quantizer.fit(x, generator=torch.Generator().manual_seed(0), iterations=2)
    return quantizer


def rows(n, seed, spread):
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 3, generator=g) * spread
    return x[torch.randint(n, (n,), generator=g)]  # some rows twice


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 24), seed=st.integers(0, 2**31), spread=st.sampled_from([1e-3, 1.0, 50.0]))
def test_symbols_and_side_information_are_all_a_decoder_needs(name, n, seed, spread):
    x = rows(n, seed, spread)
    quantizer = made(name, x)
    if hasattr(quantizer, "observing"):
        quantizer.forward(x)
        quantizer.observing = False
    decoded, symbols, side = check_quantizer(QUANTIZERS.load(name), x, trained=quantizer)
    if name not in NOT_IDEMPOTENT:
        again, _ = quantizer.encode(decoded if name != "ste-mask" else torch.where(decoded > 0, 1.0, -100.0))
        if name == "uniform":  # measures its range; it has to be told to keep it
            top = side["low"] + side["step"].astype(float) * (2.0 ** side["bits"] - 1)
            again, _ = QUANTIZERS.load(name)(low=side["low"], high=top).encode(decoded)
        assert torch.equal(again, symbols)


def test_a_quantizer_that_adds_noise_is_held_to_the_rest_of_the_contract():
    noisy = QUANTIZERS.load("uniform")(6, noise=True)
    check_quantizer(QUANTIZERS.load("uniform"), rows(20, 0, 1.0), trained=noisy, is_noisy=True)
    with pytest.raises(AssertionError, match="not those of forward"):
        check_quantizer(QUANTIZERS.load("uniform"), rows(20, 0, 1.0), trained=noisy)


@pytest.mark.parametrize("name", NAMES)
def test_gradient_reaches_what_was_quantized(name):
    x = rows(20, 0, 0.5).requires_grad_()
    made(name, x.detach()).forward(x).sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()
    assert (x.grad != 0).any()


@pytest.mark.parametrize("name", NAMES)
def test_a_training_step_leaves_no_tensor_behind_and_waits_for_none(name):
    """The device "meta" has shapes but no data: another device's tensor, or a look at a value, would fail."""
    x = rows(20, 0, 0.5)
    quantizer = made(name, x)
    if isinstance(quantizer, torch.nn.Module):
        quantizer = quantizer.to("meta")
    elif name == "vq":
        quantizer.codebook = quantizer.codebook.to("meta")
    leaf = x.to("meta").requires_grad_()
    out = quantizer.forward(leaf)
    assert out.device.type == "meta"
    assert out.shape == x.shape
    out.sum().backward()
    assert leaf.grad.device.type == "meta"
    if name == "ste-round":
        step = torch.ones(3, device="meta", requires_grad=True)
        quantizer.step_gradient = True
        quantizer.forward(leaf, step).sum().backward()
        assert step.grad.shape == (3,)


@pytest.mark.parametrize("name", NAMES)
def test_damaged_side_information_is_refused_or_decodes_to_numbers(name):
    x = rows(12, 3, 1.0)
    symbols, side = made(name, x).encode(x)
    decode = QUANTIZERS.load(name).decode
    for key in side:
        array = np.asarray(side[key])
        for value in (
            None, "text", np.array("text"), np.zeros(0), np.array([None]), array.astype(complex),
            np.full(array.shape, np.nan), np.full(array.shape, np.inf),
        ):  # fmt: skip
            with pytest.raises(BitstreamError):
                decode(symbols, {**side, key: value})
        for value in (-array.astype(float), -array.astype(int), array[..., None], array * 3, np.full((64, 64), 1e38)):
            try:
                decoded = decode(symbols, {**side, key: value})
            except BitstreamError:
                continue
            assert torch.isfinite(decoded).all()
            assert len(decoded) == len(symbols)
        with pytest.raises(BitstreamError):
            decode(symbols, {k: v for k, v in side.items() if k != key})
    for bad in (symbols + (1 << 40), symbols - (1 << 40), symbols.double()):
        with pytest.raises(BitstreamError):
            decode(bad, side)


@pytest.mark.cuda
@pytest.mark.parametrize("name", NAMES)
def test_cuda_symbols_decode_on_a_cpu(name):
    x = rows(200, 1, 1.0)
    quantizer = made(name, x)
    if isinstance(quantizer, torch.nn.Module):
        quantizer = quantizer.cuda()
    elif name == "vq":
        quantizer.codebook = quantizer.codebook.cuda()
    symbols, side = quantizer.encode(x.cuda())
    assert symbols.is_cuda
    decode = QUANTIZERS.load(name).decode
    assert torch.equal(decode(symbols, side).cpu(), decode(symbols.cpu(), side))
