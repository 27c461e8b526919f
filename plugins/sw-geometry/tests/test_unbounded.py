"""Contraction of space, and fusion in it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from sw_geometry.depth import DepthView
from sw_geometry.parameters import Parameters
from sw_geometry.unbounded import build_unbounded, contracted, expanded

from splatwizard_core.api import SplatwizardError, UserInputError

pytest.importorskip("skimage.measure", reason="marching cubes are scikit-image's")

PARAMETERS = Parameters(
    voxel_size=0.1, sdf_trunc=0.5, depth_trunc=9.0, mesh_res=48, clusters=50, min_views=1, depth_ratio=0.0,
    alpha_min=0.5, mask=True, views="train", unbounded=True, cull="none", focus=(0.5, 0, 0), radius=2.0,
)  # fmt: skip


def test_contraction_and_its_inverse():
    points = np.random.default_rng(0).normal(size=(500, 3)) * 4
    inside = np.linalg.norm(points, axis=1) <= 1
    there = contracted(points)
    assert np.array_equal(there[inside], points[inside])
    assert (np.linalg.norm(there, axis=1) < 2).all()
    assert expanded(there) == pytest.approx(points, rel=1e-9)
    assert contracted(np.array([[4.0, 0, 0]])) == pytest.approx(np.array([[1.75, 0, 0]]))


def shell(radius: float, count: int = 10) -> list[DepthView]:
    """Views from near the focus of a sphere about it, seen from inside: exact depth."""
    views = []
    focus = np.array(PARAMETERS.focus)
    for i in range(count):
        a, b = 2 * math.pi * i / count, 0.9 * math.sin(2.0 * i)
        forward = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b)])
        right = np.cross(forward, [0.0, 0, 1])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = R, -R @ focus
        y, x = np.mgrid[:48, :64]
        way = np.stack([(x + 0.5 - 32) / 32, (y + 0.5 - 24) / 32, np.ones_like(x)], axis=2)
        z = radius / np.linalg.norm(way, axis=2)
        K = np.array([[32.0, 0, 32], [0, 32, 24], [0, 0, 1]])
        views.append(DepthView(str(i), z.astype(np.float32), np.full((48, 64, 3), 0.25, dtype=np.float32), K, E))
    return views


@pytest.mark.parametrize("radius", [1.5, 6.0])  # inside the ball, and three times as far
def test_a_shell_comes_out_where_it_is(radius):
    built = build_unbounded(shell(radius), 10, PARAMETERS, label="test")
    away = np.linalg.norm(built.post.vertices - np.array(PARAMETERS.focus), axis=1)
    voxel = 2 * 1.9 / 48 * 2.0 * max(1.0, (radius / 2) ** 2)  # the contraction shrinks by the square of the distance
    assert np.abs(away - radius).mean() < 0.2 * voxel
    assert built.facts["views_used"] == 10
    assert built.post.colors == pytest.approx(0.25, abs=1e-6)
    facing = (built.post.crossed() * (built.post.corners.mean(axis=1) - np.array(PARAMETERS.focus))).sum(axis=1)
    assert (facing < 0).mean() > 0.999  # towards the cameras, which stand inside


def test_memory_is_refused_before_it_is_taken():
    with pytest.raises(UserInputError, match=r"mesh_res 1024 needs about .* GB \(limit 1 GB\): try 2\d\d"):
        build_unbounded([], 0, replace(PARAMETERS, mesh_res=1024), max_memory=1.0, label="test")


def test_no_view_has_no_surface():
    empty = [replace(view, depth=np.zeros_like(view.depth)) for view in shell(1.5, 2)]
    with pytest.raises(SplatwizardError, match="no surface: raise mesh_res"):
        build_unbounded(empty, 2, replace(PARAMETERS, mesh_res=16), label="test")
