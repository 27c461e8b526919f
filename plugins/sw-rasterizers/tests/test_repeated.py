"""Calls that are alike give what calls that are checked give."""

import pytest
import torch

from splatwizard_native import Repeated
from sw_rasterizers import face


def arguments(seed, count=5):
    generator = torch.Generator().manual_seed(seed)
    scales, quats, means = (torch.rand(count, n, generator=generator) for n in (3, 4, 3))
    means[:, 2] += 2
    camera = (1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0.1 * seed, 0, 0, 20.0, 20.0, 8.0, 8.0, 0.2, 100.0)
    return {"means": means, "scales": scales, "quats": quats, "camera": camera}


def test_later_calls_give_what_checked_ones_give():
    fixed = {"width": 16, "height": 16, "flags": 4, "scale_modifier": 1.0, "eps2d": 0.3}
    again, asked = Repeated(face, "visible_radii"), []
    for seed in range(3):
        ours, theirs = torch.zeros(5, dtype=torch.int32), torch.zeros(5, dtype=torch.int32)
        given = arguments(seed)
        again(lambda: asked.append(1) or fixed, **given, radii=ours)
        face.visible_radii(**fixed, **given, radii=theirs)
        assert torch.equal(ours, theirs)
        assert theirs.max() > 0
    assert len(asked) == 1
    with pytest.raises(RuntimeError, match="visible_radii: "):
        again(dict, width=-1)
