"""Contexts are computed a few rows at a time, with equal results: widths in a header do not decide memory."""

import torch
from sw_anchors import attribute_sections
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.row_parts import by_parts
from sw_anchors.shape import GROUPS, AnchorShape
from torch import nn


def test_parts_are_as_small_as_asked_and_give_the_whole():
    rows, seen = torch.arange(10)[:, None], []

    def evaluate(part):
        seen.append(len(part))
        return part * 2.0

    assert torch.equal(by_parts(evaluate, rows, 5, 15), rows * 2.0)
    assert seen == [3, 3, 3, 1]
    assert torch.equal(by_parts(evaluate, rows[:1], 100, 15), rows[:1] * 2.0)  # a row at least
    assert by_parts(evaluate, rows[:0], 5, 15).shape == (0, 1)


def test_a_wide_context_is_never_there_whole(monkeypatch):
    """4,096 rows of a context of 2,048 numbers, which a file of a kilobyte may claim: 64 MiB in int64."""
    monkeypatch.setattr(attribute_sections, "MAX_EXACT_NUMBERS", 1 << 16)
    shape, width, seen = AnchorShape(1, 1), 2048, []
    network = nn.Sequential(nn.Linear(width, 1), nn.ReLU(), nn.Linear(1, sum(shape.outputs)))
    nn.init.normal_(network[2].bias, generator=torch.Generator().manual_seed(0))

    def features(places):
        seen.append(len(places))
        return (places % 7).expand(-1, width)

    places = torch.arange(4096)[:, None]
    exact = ExactNetwork(network, shape, (1.0, 0.001, 0.2))
    found = exact(places, features, width)
    assert max(seen) * width <= 1 << 16
    monkeypatch.undo()
    whole = exact(places, features, 1)
    for group in GROUPS:
        for field in ("mean", "scale", "step"):
            assert torch.equal(getattr(found[group], field), getattr(whole[group], field))
