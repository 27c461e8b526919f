"""Refusals of the operations of anchors, in Python and in C, before they read or write anything."""

import pytest
import torch
from sw_anchors import face
from sw_anchors.fast import heads, noisy_values, predicted_steps, sample_bits, spawn
from sw_anchors.native import ANCHORS
from sw_anchors.noisy_values import Noise

from sw_codecs.context.two_layers import two_layers

pytestmark = pytest.mark.skipif(ANCHORS.available() is not None, reason=str(ANCHORS.available()))
G = torch.Generator().manual_seed(0)


def rand(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=G)


@pytest.mark.parametrize(
    ("drawn", "said"), [([0, 0], "0 of 6"), ([2, 1], "1 of 6"), ([0, 6], "6 of 6"), ([-1, 2], "-1 of 6")]
)
def test_gaussians_are_drawn_in_order(drawn, said):
    inputs = rand(2, 3), rand(2, 21), rand(2, 9), rand(2, 3), rand(2, 3, 3), rand(2, 6), None
    with pytest.raises(RuntimeError, match=f"^spawn: Gaussian {said} is drawn out of order"):
        spawn._Gaussians.apply(torch.tensor(drawn), *inputs)


def test_tensors_of_anchors_must_fit_one_another():
    networks = tuple(two_layers(11, 6, out * 3, G) for out in (1, 7, 3))
    center, positions, features, offsets, scales = rand(3), rand(5, 3), rand(5, 7), rand(5, 3, 3), rand(5, 6)
    for name, given in {
        "positions": (center, rand(5, 4), features, offsets, scales),
        "features": (center, positions, rand(4, 7), offsets, scales),
        "center": (rand(2), positions, features, offsets, scales),
        "scales": (center, positions, features, offsets, rand(5, 5)),
    }.items():
        with pytest.raises(RuntimeError, match=f"^heads_.*: {name} must be a .*float32 tensor"):
            heads.spawn(*given, None, networks)
    with pytest.raises(RuntimeError, match=r"opacity must be a contiguous float32 tensor \[2, 6\]"):
        heads.spawn(center, positions, features, offsets, scales, torch.ones(5, 2), networks)
    with pytest.raises(RuntimeError, match=r"^heads_sizes: networks of 0 units"):
        face.heads_sizes(units=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rows": [0, 9]}, r"rows\[1\] is 9 of 9"),
        ({"rows": [-1, 3]}, r"rows\[0\] is -1 of 9"),
        ({"drawn": [1, 0]}, r"drawn\[1\] is 0 of 2"),
        ({"drawn": [2]}, r"drawn\[0\] is 2 of 2"),
        ({"steps": rand(3, 3)}, "3 steps for 2 rows"),
        ({"uniform": rand(2, 4 + 6 + 5)}, "uniform must be a contiguous float32 tensor"),
    ],
)
def test_values_are_read_where_there_are_some(change, said):
    tables = rand(9, 4), rand(9, 6), rand(9, 2, 3), rand(9, 2)
    given = {"rows": [0, 3], "drawn": [1], "steps": rand(2, 3), "uniform": rand(2, 4 + 6 + 6), **change}
    noise = Noise(given["steps"], given["uniform"])
    with pytest.raises(RuntimeError, match=f"^noisy_values: .*{said}"):
        noisy_values.noisy_values(torch.tensor(given["rows"]), tables, None, 0.1, noise, torch.tensor(given["drawn"]))


def test_noise_has_steps_and_draws():
    tables = rand(9, 4), rand(9, 6), rand(9, 2, 3), rand(9, 2)
    noise = Noise(rand(2, 3), None)
    with pytest.raises(RuntimeError, match=r"^noisy_values: noise has steps and draws"):
        noisy_values.noisy_values(torch.tensor([0, 3]), tables, None, 0.1, noise, torch.tensor([1]))


def test_bits_and_steps_need_as_many_numbers_as_there_are():
    x, steps, masks, counted = rand(4, 10), rand(4, 3), rand(4, 2), rand(4)
    with pytest.raises(RuntimeError, match=r"^sample_bits: 10 numbers are too few for 2 offsets"):
        sample_bits.bits_of(x, x, x, steps, masks, counted, 1e-6, 1e-9)
    with pytest.raises(RuntimeError, match=r"^sample_bits: counted must be"):
        sample_bits.bits_of(rand(4, 12), rand(4, 12), rand(4, 12), steps, masks, rand(3), 1e-6, 1e-9)
    with pytest.raises(RuntimeError, match=r"^predicted_steps: last must be"):
        predicted_steps.predicted_steps(rand(4, 5), (rand(6, 5), rand(6), rand(3, 5), rand(3)), rand(3), offset=1.0)
