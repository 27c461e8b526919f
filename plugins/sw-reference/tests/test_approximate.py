"""The facts about rasterizers, held by one that is declared as approximate."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.rasterizer_checks import checks_for


class RoundedRasterizer(ReferenceRasterizer):
    """Draws pictures of 8 bit."""

    features = frozenset({"SPLIT_SH", "ALPHA_MAP", "VISIBLE_FILTER"})
    info = replace(ReferenceRasterizer.info, exactness="approx-uint8", features=features)

    def render(self, g, cam, opt):
        drawn = super().render(g, cam, opt)
        return replace(drawn, image=(255 * drawn.image).round() / 255)


class TooBright(RoundedRasterizer):
    """Off by three of 255 besides."""

    def render(self, g, cam, opt):
        drawn = super().render(g, cam, opt)
        return replace(drawn, image=drawn.image + 3 / 255)


class CalledExact(RoundedRasterizer):
    info = replace(RoundedRasterizer.info, exactness="exact")


@pytest.mark.parametrize("fact", checks_for(RoundedRasterizer.info), ids=str)
def test_a_step_of_8_bit_is_no_fault_of_an_approximate_rasterizer(fact):
    fact(RoundedRasterizer())


@pytest.mark.parametrize("kind", [TooBright, CalledExact])
def test_more_than_that_is_and_so_it_is_where_exactness_is_declared(kind):
    failed = []
    for fact in checks_for(kind.info):
        try:
            fact(kind())
        except AssertionError:
            failed.append(str(fact))
    assert len(failed) >= 4
