"""`sw info SCENE`: the facts, as JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from sw_datasets.assemble import assemble_scene
from sw_datasets.describe import describe

from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View

CAMERA = Camera.look_at(
    torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), width=64, height=48, fov_x=0.8
)


def undecoded() -> np.ndarray:
    raise AssertionError("no picture is decoded")


def made(views: int, split: str, **more) -> Scene:
    cameras = [replace(CAMERA, tau=torch.tensor([float(i), 0.0, 3.0])) for i in range(views)]
    found = [View(camera, f"{i}.png", undecoded) for i, camera in enumerate(cameras)]
    points = PointCloud(torch.tensor([[0.0, 1.0, 2.0], [-1.0, 3.0, 0.0]]))
    return assemble_scene("made", found, points=points, protocol=Protocol("made", split=split), **more)


def test_the_facts_are_plain_values():
    scene = made(8, "every4", ground_truth={"points": 1, "depth": 2})
    facts = json.loads(json.dumps(describe(scene)))
    assert facts["name"] == "made"
    assert facts["dataset"] == "made"
    assert facts["protocol"] == scene.protocol.id
    assert facts["views"] == {"train": 6, "test": 2}
    assert facts["resolutions"] == [{"width": 64, "height": 48, "views": 8}]
    assert facts["cameras"]["intrinsics"] == 1
    assert facts["cameras"]["fov_x_deg"] == pytest.approx([45.837, 45.837])
    assert facts["points"] == {"count": 2, "colours": False, "min": [-1.0, 1.0, 0.0], "max": [0.0, 3.0, 2.0]}
    assert facts["extent"] == scene.extent
    assert facts["ground_truth"] == ["depth", "points"]


def test_views_of_split_all_are_counted_once_and_warnings_are_passed_on():
    facts = describe(made(1, "all"))
    assert facts["views"] == {"train": 1, "test": 1}
    assert facts["resolutions"] == [{"width": 64, "height": 48, "views": 1}]
    assert len(facts["warnings"]) == 1
