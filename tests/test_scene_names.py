"""benchmarks/scene_names.py: a scene and its picture folder; a family before it stays."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatwizard_core.plugins import load_plugins


@pytest.mark.parametrize(
    ("text", "scene", "pictures"),
    [
        ("data/lego", "data/lego", ""),
        ("data/fox:images_2", "data/fox", "images_2"),
        ("fox:small/images_2", "fox", "small/images_2"),
        ("demos/fox:images_2", "demos/fox", "images_2"),
        ("nerf_synthetic:data/lego", "nerf_synthetic:data/lego", ""),
        ("nerf_synthetic:lego", "nerf_synthetic:lego", ""),
        ("colmap:data/fox:images_2", "colmap:data/fox", "images_2"),
        ("nerf_synthetic/lego", "nerf_synthetic/lego", ""),
        ("demo", "demo", ""),
        ("demo:tiny", "demo:tiny", ""),
    ],
)
def test_a_scene_keeps_its_family_and_gives_up_its_picture_folder(monkeypatch, text, scene, pictures):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    from scene_names import split_scene

    assert split_scene(text, load_plugins()) == (scene, pictures)
