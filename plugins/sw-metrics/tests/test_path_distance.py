"""Path distance: closed forms of cameras on a circle."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from ring_views import ring
from sw_metrics.path_distance import path_angle, path_combined, path_distance


def subject(train: list, test: list) -> SimpleNamespace:
    return SimpleNamespace(scene=SimpleNamespace(train=train, test=test))


def test_every_8th_view_of_a_circle_is_a_spacing_away():
    views = ring(64)
    case = subject([v for i, v in enumerate(views) if i % 8], views[::8])
    assert path_distance(case).per_view == pytest.approx([1.0] * 8)
    assert path_angle(case).per_view == pytest.approx([5.625] * 8)
    radius = 1.1 * 3.0
    expected = 2 * 3 * math.sin(math.pi / 64) / radius + 5.625 / 90
    assert path_combined(case).per_view == pytest.approx([expected] * 8, rel=1e-3)  # their mean is not quite the middle
    assert path_distance(case).mean == pytest.approx(1.0)


def test_the_middle_of_a_held_out_quarter_is_45_degrees_away():
    views = ring(64)
    case = subject(views[16:], views[:16])
    values = path_angle(case).per_view
    assert max(values) == pytest.approx(45.0)
    assert min(values) == pytest.approx(5.625)


def test_cameras_at_one_place_have_no_distance():
    views = ring(4)  # 3 units from the middle
    case = subject([views[0], views[0]], views[1:])
    for metric in (path_distance, path_combined):
        found = metric(case)
        assert (found.mean, found.per_view) == (None, [None] * 3)
        assert found.reason
    assert path_angle(case).mean == pytest.approx(120.0)
    assert path_distance(subject(views[:1], views[1:])).mean is None
