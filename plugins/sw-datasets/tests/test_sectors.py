"""Sectors: which cameras are held out, where the sector starts by itself, and what has no sector."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from ring_views import camera_at, ring
from sw_datasets.assemble import assemble_scene
from sw_datasets.plan_view import plan_view
from sw_datasets.sectors import plan_of, sector_of
from sw_datasets.splits import split_scene

from splatwizard_core.errors import ConfigError, SceneError
from splatwizard_core.scene.scene import PointCloud, Protocol, View


def names(views):
    return [view.name for view in views]


def test_a_quarter_of_a_circle_is_held_out():
    views = ring(64)
    train, test, rule = split_scene(views, "sector:90@0")
    assert rule == "sector:90@0"
    assert names(test) == names(views[:16])  # 0 .. 84.375 degrees; 90 is outside
    assert names(train) == names(views[16:])


def test_the_plan_is_that_of_the_circle():
    views = ring(8, offset=30)
    plan = plan_of([view.camera for view in views])
    np.testing.assert_allclose(plan.focus, 0, atol=1e-12)
    centres = np.stack([view.camera.center.numpy() for view in views])
    np.testing.assert_allclose(plan.azimuths(centres), [45 * i for i in range(8)], atol=1e-6)


def test_the_start_is_the_one_of_the_median_count_and_stands_in_the_rule():
    cameras = [camera_at(a, 3.0) for a in [0, 1, 2, 3, *range(20, 360, 20)]]  # crowded at 0
    views = [View(camera, f"{i:03d}.png") for i, camera in enumerate(cameras)]
    train, test, rule = split_scene(views, "sector:60")
    assert rule == "sector:60@10"  # three of these are in most sectors, and 10 is the first such
    assert len(test) == 3
    assert len(train) == len(views) - 3
    assert split_scene(views, rule)[2] == rule
    assert names(split_scene(views, rule)[1]) == names(test)


def test_no_more_than_half_is_held_out_where_the_start_is_free():
    views = [View(camera_at(a, 3.0), f"{a:03d}.png") for a in (0, 5, 10, 15, 20, 25, 180)]
    rule = split_scene(views, "sector:60")[2]
    assert 2 * len(split_scene(views, rule)[0]) >= len(views)
    together = [View(camera_at(a, 3.0), f"{a:03d}.png") for a in (0, 1, 2)]
    with pytest.raises(SceneError, match="no sector of it leaves half"):
        split_scene(together, "sector:180")


@pytest.mark.parametrize("rule", ["sector:5", "sector:181", "sector:60@360"])
def test_a_sector_out_of_range_is_refused(rule):
    with pytest.raises(SceneError, match="give 10 to 180 degrees"):
        split_scene(ring(16), rule)


def test_cameras_that_look_ahead_or_away_have_no_sector():
    ahead = [dataclasses.replace(camera_at(0, 3.0), tau=torch.tensor([float(i), 0.0, 3.0])) for i in range(9)]
    with pytest.raises(SceneError, match="use block"):
        sector_of(ahead, ahead, 60, None)
    with pytest.raises(SceneError, match="look away"):
        split_scene(ring(16, inward=False), "sector:60")


def test_the_halves_of_a_scene_are_split_each_by_itself():
    train, test = ring(64, prefix="train/"), ring(32, prefix="test/")
    views = [*train, *test]
    own = (train, test)
    kept, held, rule = split_scene(views, "sector:90@0", own)
    assert rule == "file+sector:90@0"
    assert names(kept) == names(train[16:])
    assert names(held) == names(test[:8])
    kept, held, rule = split_scene(views, "sparse:2", own)
    assert (rule, names(kept), names(held)) == ("file+sparse:2", names([train[0], train[-1]]), names(test))
    assert split_scene(views, "file+sparse:2", own)[2] == "file+sparse:2"


def test_of_many_held_out_views_every_few_are_tested():
    views = ring(4002)
    train, test, _ = split_scene(views, "sector:180@0")
    assert len(train) == 2001
    assert names(test) == names(views[:2001:3])


def scene(split: str, points: str = "", seen=True, **more):
    views = ring(16)
    cloud = PointCloud(torch.arange(30.0).reshape(10, 3))

    def of_training(train):  # each of the first points is of the view of its number
        kept = {int(view.name[:3]) for view in train}
        return PointCloud(cloud.xyz[[i for i in range(10) if i in kept]])

    protocol = Protocol("made", split=split, points=points)
    return assemble_scene(
        "made", views, points=cloud, train_points=of_training if seen else None, protocol=protocol, **more
    )


def test_start_points_of_held_out_views_alone_are_left_out():
    found = scene("block:0of4")
    assert found.protocol.id == "made/images/r-1/block:0of4/black/pp-center/q8/pts-train"
    assert len(found.points) == 6  # of the views 4 .. 9
    assert "6 of 10 start points are used" in " ".join(found.warnings)
    assert len(scene("block:0of4", "all").points) == 10
    assert scene("block:0of4", "all").protocol.id.endswith("/q8/pts-all")


def test_without_tracks_the_id_says_that_points_may_leak():
    found = scene("sector:90@0", seen=False)
    assert found.protocol.id.endswith("/pts-all")
    assert any("held-out views too" in line for line in found.warnings)
    with pytest.raises(ConfigError, match="nothing tells which views saw"):
        scene("sector:90@0", "train", seen=False)


def test_ids_of_other_splits_stay_as_they_were():
    assert scene("every8").protocol.id == "made/images/r-1/every8/black/pp-center/q8"
    assert scene("every8", "all").protocol.id == "made/images/r-1/every8/black/pp-center/q8"
    assert scene("every8", "train").protocol.id == "made/images/r-1/every8/black/pp-center/q8/pts-train"


def test_tracks_of_a_reconstruction_say_who_saw_a_point(colmap_folder, load):
    # The one track of each point names image 1, the first by name.
    root = colmap_folder.write()
    found = load(root, split="block:1of2")
    assert found.protocol.id.endswith("block:1of2/black/pp-center/q8/pts-train")
    assert len(found.points) == 5
    with pytest.raises(SceneError, match="no training view saw any of the 5"):
        load(root, split="block:0of2")
    assert len(load(root, split="block:0of2", points="all").points) == 5


def test_the_plan_view_shows_every_camera_of_either_half():
    found = scene("sector:90@0")
    text = plan_view(found)
    assert text.count("<path") == 16
    assert "12 trained" in text
    assert "4 held out" in text
    both = plan_view(scene("all"))
    assert both.count("<path") == 16
    ahead = [View(dataclasses.replace(camera_at(0, 3.0), tau=torch.tensor([float(i), 0.0, 3.0], dtype=torch.float64)),
                  f"{i}.png") for i in range(9)]  # fmt: skip
    text = plan_view(assemble_scene("made", ahead, points=None, protocol=Protocol("made")))
    assert "nan" not in text
    assert text.count("<path") == 9
