"""Bits straight from the outputs of networks, in one node: its kernels against torch operations in float64."""

import pytest
import torch

from sw_codecs.entropy import further_rates, rates
from sw_hac.fast.predicted_bits import MaskKind, Predicted, have_kernels, mixture_bits
from sw_hac.native import HAC
from sw_hac_plus.channel_mixture import ChannelMixture
from sw_hac_plus.fast.channel_networks import ChannelNetworks

ON_CUDA = HAC.available(cuda=True)
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]),
]
SMALLEST_SCALE = 0.3
"""So large that deviations are on both sides of it."""


def channel_of(kind, slices):
    g = torch.Generator().manual_seed(1)
    hidden = {"full": 7, "tiny": None}.get(kind)
    return None if kind == "none" else ChannelMixture(slices, context=0 if kind == "tiny" else 3 * sum(slices),
                                                      hidden=hidden, generator=g)  # fmt: skip


def sample_of(count, features, k, *, seed=0, logits=True):
    """x, outputs, steps, masks, counted, units of a sample whose deviations are some steps, in float32."""
    g = torch.Generator().manual_seed(seed)
    numbers = features + 6 + 3 * k

    def draw(*shape, low=-1.0, high=1.0):
        return low + (high - low) * torch.rand(shape, generator=g)

    width = 2 * numbers + (3 + features if logits else 0)
    units = draw(width, low=0.5, high=1.5)
    outputs = 3 * draw(count, width)
    start = 0
    for size in (features, 6, 3 * k):
        outputs[:, start + size : start + 2 * size] = draw(count, size, low=-0.2, high=2.0)  # deviations
        start += 2 * size
    masks = (draw(count, k) > -0.4).float()
    masks[::5] = 0  # anchors that are off
    return [3 * draw(count, numbers), outputs, draw(count, 3, low=0.5), masks, (draw(count) > -0.7).float(), units]


def by_torch(x, outputs, steps, masks, counted, predicted, channel):
    """Compute the same bits, operator by operator."""
    k = masks.shape[1]
    f = x.shape[1] - 6 - 3 * k
    outputs = outputs * predicted.units
    parts = outputs[:, : 2 * x.shape[1]].split([f, f, 6, 6, 3 * k, 3 * k], dim=1)
    wide = steps.repeat_interleave(torch.tensor([f, 6, 3 * k], device=x.device), dim=1)

    def floored(scale, steps, offsets):
        if predicted.scale_floor:
            return rates.lower_bound(scale, torch.maximum(predicted.scale_floor * steps, offsets.abs() / 5).detach())
        return scale.clamp(min=predicted.smallest_scale)

    mean = torch.cat(parts[0::2], dim=1)
    scale = floored(torch.cat(parts[1::2], dim=1), wide, x - mean)
    bits = rates.gaussian_bits(x, mean, scale, wide, p_min=predicted.smallest)
    if channel is not None:
        base, logit = predicted.base, outputs[:, -f:]
        context = torch.cat([parts[0] / base, parts[1] / base, logit], dim=1)
        second_mean, second_scale, second_logit = channel(x[:, :f] / base, context)
        mixed = further_rates.mixture_bits(
            x[:, :f],
            torch.stack([logit, second_logit], -1),
            torch.stack([mean[:, :f], base * second_mean], -1),
            torch.stack([scale[:, :f], floored(base * second_scale, wide[:, :f], x[:, :f] - base * second_mean)], -1),
            wide[:, :f],
            p_min=predicted.smallest,
        )
        bits = torch.cat([mixed, bits[:, f:]], dim=1)
    there, offsets = counted[:, None], masks
    if predicted.masks != MaskKind.ALONE:
        mean = masks.mean(dim=1, keepdim=True)
        on = (mean > 0).to(mean)
        gate = mean + (on - mean).detach() if predicted.masks == MaskKind.GATED_MEAN else on
        there = gate * there
        offsets = there * masks
    bits = bits * torch.cat([there.expand(-1, f + 6), offsets.repeat_interleave(3, dim=1)], dim=1)
    return bits.sum(), torch.stack([part.sum() for part in bits.detach().split([f, 6, 3 * k], dim=1)])


def both(kind, slices, k, count, *, device="cpu", masks=MaskKind.GATED_MEAN, floor=0.0, change=lambda given: None):
    """(by kernel in float32, by torch in float64): bits, by group, then derivatives of half the bits."""
    channel = channel_of(kind, slices)
    given = sample_of(count, sum(slices), k, logits=kind != "none")
    change(given)
    found = []
    for dtype in (torch.float32, torch.float64):
        *tensors, counted, units = (t.to(device, dtype) for t in given)
        leaves = [t.requires_grad_() for t in tensors]
        predicted = Predicted(units, 0.8, 1e-6, SMALLEST_SCALE, floor, masks)
        networks, parameters = None, []
        if channel is not None:
            channel = channel.to(device, dtype)
            networks, parameters = ChannelNetworks(channel, units.device), ChannelNetworks.parameters(channel)
        assert have_kernels(*leaves, counted, *parameters) == (dtype == torch.float32)
        if dtype == torch.float32:
            bits, by_group = mixture_bits(*leaves, counted, predicted, networks, tuple(parameters))
        else:
            bits, by_group = by_torch(*leaves, counted, predicted, channel)
        names = ["x", "outputs", "steps", "masks", *(f"parameter {i}" for i in range(len(parameters)))]
        grads = torch.autograd.grad(0.5 * bits, [*leaves, *parameters], allow_unused=True)
        found.append({"bits": bits.detach(), "by group": by_group, **dict(zip(names, grads, strict=True))})
    return found


def assert_close(kernel, torch_form, tolerance=1e-4):
    assert kernel.keys() == torch_form.keys()
    for name, expected in torch_form.items():
        got = kernel[name]
        expected = torch.zeros_like(got) if expected is None else expected
        limit = tolerance * float(expected.abs().max()) if expected.numel() else 0.0
        torch.testing.assert_close(got.double(), expected.double(), rtol=tolerance, atol=limit + 1e-12, msg=name)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("masks", list(MaskKind))
@pytest.mark.parametrize("floor", [0.0, 0.6])
@pytest.mark.parametrize("kind", ["full", "tiny", "none"])
def test_bits_and_gradients_are_those_of_torch_operations(kind, masks, floor, device):
    kernel, expected = both(kind, [3, 5, 2], 4, 60, device=device, masks=masks, floor=floor)
    assert_close(kernel, expected)
    assert float(expected["bits"]) > 100
    assert all(bool((grad != 0).any()) for grad in expected.values() if grad is not None)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("slices", "k", "count"), [([10] * 5, 10, 33), ([1], 1, 1), ([16, 17], 2, 65), ([4, 4], 3, 0), ([1] * 9, 11, 9)]
)
def test_sizes_do_not_matter(slices, k, count, device):
    assert_close(*both("full", slices, k, count, device=device))


@pytest.mark.parametrize("device", DEVICES)
def test_a_probability_below_its_floor_keeps_its_bits_and_the_gradient_that_raises_it(device):
    def far(given):
        x, outputs, _, masks, counted, units = given
        units.fill_(1), counted.fill_(1), masks.fill_(1)
        outputs[:, :20] = 0.7  # means 0.7 and deviations 0.7 of features
        x[:, :10] = 5.0

    kernel, expected = both("none", [3, 5, 2], 4, 60, device=device, change=far)
    assert_close(kernel, expected)
    assert float(kernel["by group"][0]) > 60 * 10 * 19.0
    assert bool((kernel["x"][:, :10] > 0).all())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_nan_is_not_hidden(which, device):
    def broken(given):
        given[3].fill_(1), given[4].fill_(1)
        given[which][0, 0] = float("nan")

    kernel, _ = both("full", [3, 5, 2], 4, 6, device=device, change=broken)
    assert kernel["bits"].isnan()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("logit", [-60.0, 60.0])
def test_weights_that_are_as_good_as_certain_have_finite_gradients(logit, device):
    def certain(given):
        given[1][:, -10:], given[5][-10:] = logit, 1.0

    kernel, expected = both("full", [3, 5, 2], 4, 60, device=device, change=certain)
    assert all(bool(torch.isfinite(each).all()) for each in kernel.values())
    assert_close(kernel, expected)


def test_the_kernel_gives_the_same_bits_on_any_number_of_threads():
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            kernel, _ = both("none", [3, 5, 2], 4, 300)
            found.append(kernel)
    finally:
        torch.set_num_threads(before)
    for name in ("by group", "x", "outputs", "steps", "masks"):
        assert torch.equal(found[0][name], found[1][name]), name


def test_networks_that_see_another_context_are_refused():
    with pytest.raises(ValueError, match="a context of 5 numbers for 4 features is not offered"):
        ChannelNetworks(ChannelMixture([2, 2], context=5), torch.device("cpu"))


@pytest.mark.parametrize(
    ("features", "device", "said"), [(4, "cpu", "4 channels on cpu"), (5, "meta", "5 channels on meta")]
)
def test_networks_of_other_channels_or_on_another_device_are_refused(features, device, said):
    *tensors, counted, units = sample_of(6, 5, 2)
    channel = ChannelMixture([2, features - 2], context=3 * features)
    networks, parameters = ChannelNetworks(channel, torch.device(device)), tuple(ChannelNetworks.parameters(channel))
    predicted = Predicted(units, 0.8, 1e-6, SMALLEST_SCALE, 0.0, MaskKind.GATED)
    with pytest.raises(ValueError, match=f"networks of {said} are not for 5 features on cpu"):
        mixture_bits(*tensors, counted, predicted, networks, parameters)


@pytest.mark.parametrize("starts", [(0, 1), (1, 2)])
def test_slices_that_leave_a_channel_out_are_refused(starts):
    channel = ChannelMixture([2, 2], context=0)
    channel.starts = starts
    with pytest.raises(ValueError, match=r"slices \[2, 2\] at \[., .\] are not the channels, each once"):
        ChannelNetworks(channel, torch.device("cpu"))


@pytest.mark.parametrize(
    ("change", "said"),
    [("outputs", "20 outputs are too few for 16 numbers"), ("units", r"units .* \[39\] "), ("kind", "no kind 7")],
)
def test_tensors_of_wrong_sizes_are_refused(change, said):
    x, outputs, steps, masks, counted, units = sample_of(5, 4, 2)
    kind = 7 if change == "kind" else 1
    if change == "outputs":
        outputs, units = outputs[:, :20], units[:20]
    units = units[:-1] if change == "units" else units
    predicted = Predicted(units, 1.0, 1e-6, 1e-9, 0.0, kind)
    with pytest.raises(RuntimeError, match=f"^mixture_bits: .*{said}"):
        mixture_bits(x, outputs, steps, masks, counted, predicted)
