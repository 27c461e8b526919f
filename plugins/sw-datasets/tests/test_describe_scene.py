"""`sw info SCENE`: the facts, as JSON."""

from __future__ import annotations

import json

from splatwizard_core.scene.describe import describe


def test_facts_of_the_tiny_demo(load):
    scene = load("demo:tiny")
    facts = json.loads(json.dumps(describe(scene)))
    assert facts["name"] == "demo-tiny"
    assert facts["dataset"] == "demo"
    assert facts["protocol"] == scene.protocol.id
    assert facts["views"] == {"train": 6, "test": 2}
    assert facts["resolutions"] == [{"width": 64, "height": 48, "views": 8}]
    assert facts["cameras"]["intrinsics"] == 1
    assert facts["cameras"]["fov_x_deg"] == [46.0, 46.0]
    assert facts["points"]["count"] == 600
    assert facts["extent"] == scene.extent
    assert facts["ground_truth"] == ["depth", "normals", "points"]
    assert not any("pixels" in view.__dict__ for view in scene.train), "no picture is decoded"


def test_views_of_split_all_are_counted_once_and_warnings_are_passed_on(colmap_folder, load):
    colmap_folder.names = ["a.png"]
    facts = describe(load(colmap_folder.write(), split="all"))
    assert facts["views"] == {"train": 1, "test": 1}
    assert facts["resolutions"] == [{"width": 32, "height": 24, "views": 1}]
    assert len(facts["warnings"]) == 1
