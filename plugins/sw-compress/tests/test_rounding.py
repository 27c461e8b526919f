"""Rounding on the device of a model against the codec's own, and entropies against those of columns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sw_compress import rounding
from sw_compress.coders import columns_bits
from sw_compress.rounding import (
    Rounding,
    Steps,
    canonical,
    classes_on_device,
    entropy_bits,
    equal_classes,
    on_grid,
    sorted_grid,
)

from sw_codecs.models import band_context, gauge, precision
from sw_codecs.models.position_grid import PositionGrid

STEPS = Steps({"opacity": 0.2, "scale": 0.1, "quat": 0.05, "dc": 0.05, "rest": 0.04}, 12)


def test_quaternions_and_scales_are_as_the_codec_turns_them():
    random = np.random.default_rng(0)
    scales, quats = random.normal(size=(500, 3)), random.normal(size=(500, 4))
    scales[:20, 1] = scales[:20, 0]  # equal ones keep their order
    quats[20] = 0
    known_scales, known = gauge.canonical(scales, quats)
    found_scales, found = canonical(torch.from_numpy(scales), torch.from_numpy(quats))
    assert np.array_equal(known_scales, found_scales.numpy())
    np.testing.assert_allclose(found.numpy(), known[:, 1:], atol=1e-14)


def test_positions_lie_in_the_cells_of_the_codec():
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    points[:9] *= 1000
    grid = PositionGrid.fit(points, 14)
    assert np.array_equal(on_grid(torch.from_numpy(points), grid).numpy(), grid.dequantize(grid.quantize(points)))


@pytest.mark.parametrize("count", [1, 2, 500, 501, 502, 503])
def test_grids_by_sorting_are_those_of_the_codec(count: int):
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    points[:9] *= 1000
    assert sorted_grid(torch.from_numpy(points)) == PositionGrid.fit(points, 1)


@pytest.mark.parametrize("count", [0, 1, 500, 501])
def test_classes_on_a_device_are_those_of_the_codec(count: int):
    weights = np.random.default_rng(count).lognormal(0, 3, count)
    weights[: count // 4] = 0
    assert np.array_equal(classes_on_device(torch.from_numpy(weights), 0.4), precision.classes_of(weights, 0.4))


def test_one_attribute_changes_alone(ball):
    found = Rounding(ball(300), 0.4, True)
    whole = found.model_at(STEPS)
    finer = replace(STEPS, of={**STEPS.of, "rest": 0.001})
    changed = found.change(found.model_at(STEPS), "rest", finer)
    assert torch.equal(changed.sh_rest, found.model_at(finer).sh_rest)
    assert not torch.equal(changed.sh_rest, whole.sh_rest)
    assert torch.equal(changed.quats, whole.quats)
    for name in ("quat", "opacity", "dc", "scale", "positions"):  # and back again, in place
        assert found.change(changed, name, STEPS) is changed
    assert torch.equal(found.change(changed, "rest", STEPS).sh_rest, whole.sh_rest)


def test_what_is_not_kept_is_found_again(ball, monkeypatch):
    model = ball(300)
    known = Rounding(model, 0.4, True).model_at(STEPS)
    monkeypatch.setattr(rounding, "TURNED_ONCE", 100)
    monkeypatch.setitem(rounding.ROWS_AT_ONCE, "cpu", 128)
    again = Rounding(model, 0.4, True)
    for found in (again.model_at(STEPS), again.overwrite(STEPS)):
        for name in known.RAW:
            assert torch.equal(getattr(found, name), getattr(known, name)), name


@pytest.mark.parametrize("spread", [0, 3, 40_000])
def test_entropies_are_those_of_each_class(spread: int):
    random = np.random.default_rng(0)
    symbols = random.integers(-spread, spread + 1, (5000, 3)).astype(np.int32)
    classes = random.integers(0, 4, 5000)
    symbols, classes = torch.from_numpy(symbols), torch.from_numpy(classes)
    known = sum(columns_bits(symbols[classes == k]) for k in range(4))
    found = entropy_bits(symbols, classes, 4, 3.0)
    assert found == pytest.approx(known, rel=2e-3)


def test_classes_are_as_large_as_those_of_the_codec():
    values = np.random.default_rng(0).integers(0, 50, 1000)
    assert np.array_equal(equal_classes(torch.from_numpy(values), 8).numpy(), band_context.equal_classes(values, 8))


@pytest.mark.cuda
def test_a_gpu_rounds_alike(ball):
    on_cpu, on_gpu = (Rounding(ball(2000).to(device), 0.4, True).model_at(STEPS) for device in ("cpu", "cuda"))
    for name in on_cpu.RAW:
        different = (getattr(on_cpu, name) - getattr(on_gpu, name).cpu()).abs() > 1e-5
        assert float(different.float().mean()) < 1e-3, name  # a value between two steps may fall on either side
