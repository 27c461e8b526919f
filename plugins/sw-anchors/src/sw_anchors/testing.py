"""Test helpers for anchor methods: compare the fast versions of a training step with the plain one.

def test_fast_forms_change_nothing():
    check_plain(make_model, camera, counts=(0, 1, 40))
    check_replayed(make_model, camera, counts=(0, 1, 40))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from splatwizard_core.api import Camera
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED, CodedAnchors
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.fast import fixed_step
from sw_anchors.fast.fixed_step import FixedRows, PoolRows
from sw_anchors.fast.replay import FixedDecoder
from sw_anchors.fast.seen_rows import SeenRows, capacity_of
from sw_anchors.growth import accumulate_anchor_statistics
from sw_anchors.stage import mean_product
from sw_codecs.exact_native import EXACT

PHASES = (FULL, QUANTIZED, ENTROPY)


def check_replayed(
    make: Callable[[], CodedAnchors],
    camera: Camera,
    *,
    counts: Sequence[int],
    phases: Sequence[str] = PHASES,
    graphs: bool = False,
    sample: float = 0.3,
    tolerance: float = 1e-4,
) -> None:
    """Raise AssertionError unless a step in tensors of fixed sizes is the same, for counts of visible anchors.

    What is drawn of the Gaussians is left out: a rasterizer cuts them off, and a rounding decides on which side.

    make        the same model each time
    graphs      as CUDA graphs
    tolerance   of values, rate, gradients and statistics, as a share of the largest value of each tensor
    """
    fixed = FixedDecoder(graphs=graphs)
    same = make()
    for phase in phases:
        for count in counts:
            # Graphs belong to one model; what a step changes is put back.
            expected = _one_step(make(), None, camera, phase, count, sample)
            _compare(expected, _one_step(same, fixed, camera, phase, count, sample), phase, count, tolerance)


def check_plain(
    make: Callable[[], CodedAnchors],
    camera: Camera,
    *,
    counts: Sequence[int],
    phases: Sequence[str] = PHASES,
    sample: float = 0.3,
    tolerance: float = 1e-4,
) -> None:
    """Raise AssertionError unless a step with SW_FAST=0 is the same as with the fast forms; arguments as above."""
    for phase in phases:
        for count in counts:
            found = _one_step(make(), None, camera, phase, count, sample)
            with mock.patch.dict("os.environ", SW_FAST="0"):
                expected = _one_step(make(), None, camera, phase, count, sample)
            _compare(expected, found, phase, count, tolerance)


def _compare(expected: dict[str, Tensor], found: dict[str, Tensor], phase: str, count: int, tolerance: float) -> None:
    for name in expected.keys() | found.keys():
        # A sample without an anchor: no gradient in one form, zeros in the other.
        right, got = (each.get(name, torch.zeros(())) for each in (expected, found))
        limit = tolerance * max(float(right.abs().amax()), 1e-6) if right.numel() else 0.0
        difference = float((right - got).abs().amax()) if got.numel() else 0.0
        assert difference <= limit, f"{phase}, {count} anchors, {name}: {difference:.3g} apart"


def check_without_kernels(encoded: Callable[[], bytes], decoded: Callable[[bytes], DecodedAnchors]) -> None:
    """Raise unless a file, and what it decodes to, are the same with SW_FAST=0, and without kernels of exact coding."""
    data = encoded()
    expected = decoded(data)
    with mock.patch.dict("os.environ", SW_FAST="0"):
        assert encoded() == data
    with (
        mock.patch.object(type(EXACT), "try_load", return_value=False),
        mock.patch.object(type(EXACT), "load_built", return_value=False),
    ):
        assert encoded() == data
        found = decoded(data)
    for name in ("features", "scales", "offsets", "masks"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def check_nothing_is_waited_for(model: CodedAnchors) -> None:
    """Raise where values and rate of 300 anchors of a model in its last phase, on a GPU, make the CPU wait for it."""
    rows = torch.arange(300, device=model.device)
    model.train()
    model.sample = 0.5

    def step() -> Any:
        attributes = model.attributes(rows)
        rate = attributes.extras["rate"]
        (attributes.features.mean() + rate.bits + 1e-5 * rate.own_bits).backward()
        return rate

    step()  # what is kept on the device is made
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        rate = step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert float(rate.bits) > 0
    assert all(bool(torch.isfinite(p.grad).all()) for p in model.parameters() if p.grad is not None)


def _one_step(
    model: CodedAnchors, decoder: FixedDecoder | None, camera: Camera, phase: str, count: int, sample: float
) -> dict[str, Tensor]:
    """Loss, rate, gradients by name and statistics of a step on `count` anchors, with the same draws in all forms."""
    model.train().zero_grad()
    model.phase, model.sample = phase, sample
    device = model.device
    generator = torch.Generator().manual_seed(count)
    rows = torch.randperm(model.num_rows, generator=generator)[:count].sort().values.to(device)
    capacity = max(capacity_of(count), capacity_of(model.num_rows))
    noise = torch.rand(capacity, sum(model.shape.widths), generator=generator).to(device)
    draws = torch.rand(capacity, generator=generator).to(device)

    def fill(at: FixedRows | PoolRows, _: Any) -> None:
        count = len(at.parameters[0])
        parts = [noise[:count].flatten()] + ([draws[:count]] if isinstance(at, FixedRows) else [])
        at.random.copy_(torch.cat(parts) - 0.5)

    def pool(uniform: Tensor, count: int, share: float) -> tuple[Tensor, Tensor]:
        drawn = torch.nonzero(draws[:count] < share).squeeze(1)
        rest = drawn.new_full((len(uniform) - len(drawn),), count - 1)
        return torch.cat([drawn, rest]), (torch.arange(len(uniform), device=device) < len(drawn)).to(noise)

    with (
        mock.patch.object(FixedRows, "draw", fill),
        mock.patch.object(PoolRows, "draw", fill),
        mock.patch.object(fixed_step, "bernoulli_rows", pool),
        mock.patch.object(model, "draw_noise", lambda *shape: noise[: shape[0]].clone()),
        mock.patch.object(model, "draw_sample", lambda n: torch.nonzero(draws[:n] < sample).squeeze(1)),
    ):
        inputs = model.decode(camera, rows) if decoder is None else decoder.decode(model, camera, SeenRows(rows))
    assert inputs is not None
    drawn = {name: t for name, t in inputs.tensors().items() if t.is_floating_point()}
    assert inputs.scales is not None
    found = {"volume": mean_product(inputs.scales, max(len(inputs.scales), 1))}
    rate = inputs.extras.get("rate")
    if rate is not None:
        found |= {"bits": rate.bits} | ({} if rate.own_bits is None else {"own bits": 1e-4 * rate.own_bits})
    slopes = {name: torch.rand(t.shape, generator=generator).to(device) for name, t in drawn.items()}
    total = torch.stack([(t * slopes[name]).sum() for name, t in drawn.items()]).sum()
    total = total + torch.stack(list(found.values())).sum() * 10
    total.backward()  # type: ignore[no-untyped-call]
    statistics = ("opacity_accum", "anchor_denom", "offset_grad_accum", "offset_denom")
    for name in statistics:
        getattr(model, name).zero_()
    radii = (slopes["opacities"] > 0.3).int()
    accumulate_anchor_statistics(model, inputs.extras["anchors"], slopes["means"][:, :2], radii)
    found |= {name: getattr(model, name).clone() for name in statistics}
    found |= {f"d {name}": p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}
    if rate is not None:
        found |= {"by group": rate.by_group, "numbers": rate.numbers}
    return {name: tensor.detach().cpu() for name, tensor in {**found, **drawn, "loss": total}.items()}
