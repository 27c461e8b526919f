"""Contexts of the file, a few anchors at a time: a file of 20 kB with 6,144 features an anchor took 9.8 GB."""

import pytest
import torch
from sw_anchors.shape import GROUPS

from sw_cat_3dgs.context import CatContext
from sw_cat_3dgs.rate_model import CatRateModel
from sw_cat_3dgs.triplane import UNIT


@pytest.mark.parametrize("mode", ["exact", "float"])
def test_wide_contexts_are_computed_a_few_anchors_at_a_time(mode, method, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    context = CatContext(method().shape(), generator)
    for i, plane in enumerate(context.triplane.initial(5, generator)):
        setattr(context.triplane.planes, str(i), torch.nn.Parameter(plane * 1000))
    context.rounded = True
    places = torch.randint(0, UNIT + 1, (200, 3), generator=generator)
    with torch.no_grad():
        whole = CatRateModel.of_file(context).predictor(mode).first(places)
        seen, limit = [], 30 * context.triplane.width
        monkeypatch.setattr("sw_anchors.attribute_sections.MAX_EXACT_NUMBERS", limit)
        monkeypatch.setattr("sw_cat_3dgs.rate_model.MAX_FLOAT_NUMBERS", limit)
        context.network.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
        predictor = CatRateModel.of_file(context).predictor(mode)
        if mode == "exact":
            lookup = predictor._lookup
            predictor._lookup = lambda part: (seen.append(len(part)), lookup(part))[1]
        found = predictor.first(places)
    assert 0 < max(seen) <= 30
    for group in GROUPS:
        for field in ("mean", "scale", "step"):
            ours, expected = (torch.as_tensor(getattr(each[group], field)) for each in (found, whole))
            assert torch.equal(ours, expected) if mode == "exact" else torch.allclose(ours, expected)
