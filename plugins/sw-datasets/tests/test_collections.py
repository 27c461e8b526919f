"""The published collections in their exact layouts: what is recognised, and by which rules it is read."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from sw_datasets.downloads.registry import load_registry
from sw_datasets.families import BENCHMARKS, INDOOR, OUTDOOR
from sw_datasets.loaders.colmap_model import ColmapCamera

from splatwizard_core.errors import ConfigError, SceneError
from splatwizard_core.plugins import load_plugins


def reduced(root: Path, factor: int, suffix: str = ".JPG") -> None:
    """images_<factor>, as the authors of Mip-NeRF 360 made them: JPEG of the same stem."""
    for file in sorted((root / "images").rglob("*.png")):
        picture = Image.open(file).convert("RGB")
        small = (round(picture.width / factor), round(picture.height / factor))
        target = (root / f"images_{factor}" / file.relative_to(root / "images")).with_suffix(suffix)
        target.parent.mkdir(parents=True, exist_ok=True)
        picture.resize(small).save(target, format="JPEG")


@pytest.fixture
def colmap_scene(colmap_folder, tmp_path):
    """colmap_scene("tandt/train", ..) -> its folder below tmp_path, with attributes of the ColmapFolder changed."""

    def make(place, **changes):
        made = replace(colmap_folder, root=tmp_path / place, **changes)
        return made.write()

    return make


@pytest.fixture
def mipnerf360(colmap_scene):
    """mipnerf360("garden") -> the layout of the archive: images, images_2, images_4, images_8, sparse/0."""

    def make(scene="garden", home="360_v2", **changes):
        root = colmap_scene(f"{home}/{scene}", **changes)
        for factor in (2, 4, 8):
            reduced(root, factor)
        return root

    return make


@pytest.mark.parametrize(
    ("place", "views", "protocol"),
    [
        ("360_v2/garden", 25, "mipnerf360/images/r-1/every8/black/pp-center/q8"),
        ("tandt/truck", 25, "tandt/images/r-1/every8/black/pp-center/q8"),
        ("db/playroom", 25, "db/images/r-1/every8/black/pp-center/q8"),
        ("BungeeNeRF/rome", 100, "bungee/images/r-1/lod:30/black/pp-center/q8"),
    ],
)
def test_a_published_scene_in_its_home_is_read_by_its_rules(colmap_scene, load, place, views, protocol):
    names = [f"{i:03d}.png" for i in range(views)]
    scene = load(colmap_scene(place, names=names))
    assert scene.protocol.id == protocol
    assert scene.protocol.name == "survey"
    tested = range(31) if "lod" in protocol else range(0, views, 8)
    assert [view.name for view in scene.test] == [names[i] for i in tested]
    assert scene.warnings == []


def test_a_name_alone_is_no_proof(colmap_scene, load):
    for place in ("mine/garden", "mine/truck", "mine/rome"):
        assert load(colmap_scene(place)).protocol.dataset == "colmap"


def test_a_collections_folder_does_not_make_a_scene_of_it(colmap_scene, load):
    assert load(colmap_scene("tandt/my cat")).protocol.dataset == "colmap"


def test_what_the_archive_holds_besides_proves_the_name(mipnerf360, load):
    assert load(mipnerf360(home="downloads")).protocol.dataset == "mipnerf360"
    assert load(mipnerf360("backyard", home="downloads")).protocol.dataset == "colmap"


def test_a_link_is_read_as_what_it_leads_to(mipnerf360, load, tmp_path):
    (tmp_path / "here").symlink_to(mipnerf360())
    assert load(tmp_path / "here").protocol.dataset == "mipnerf360"
    assert load(tmp_path / "here").name == "garden"


def test_a_link_with_a_published_name_goes_by_it(colmap_scene, load, tmp_path):
    (tmp_path / "tandt").mkdir()
    (tmp_path / "tandt" / "truck").symlink_to(colmap_scene("blobs/4fe1"))
    scene = load(tmp_path / "tandt" / "truck")
    assert (scene.name, scene.protocol.dataset, scene.protocol.name) == ("truck", "tandt", "survey")


def test_the_working_directory_is_recognised_too(mipnerf360, load, monkeypatch):
    monkeypatch.chdir(mipnerf360())
    assert load(".").protocol.dataset == "mipnerf360"


@pytest.mark.parametrize("scene", OUTDOOR + INDOOR)
def test_inria_takes_the_reduced_jpegs_that_its_table_was_made_with(mipnerf360, load, scene):
    factor = 4 if scene in ("bicycle", "flowers", "garden", "stump", "treehill") else 2
    found = load(mipnerf360(scene, names=["a.png", "b.png"]), protocol="inria")
    assert found.protocol.id == f"mipnerf360/images_{factor}/r-1/every8/black/pp-center/q8"
    assert found.protocol.name == "inria"
    camera = found.train[0].camera
    assert (camera.width, camera.height) == (32 // factor, 24 // factor)
    assert camera.fov_x == pytest.approx(2 * math.atan(32 / 60))


def test_survey_is_the_default_and_reduces_to_1600_px(colmap_scene, load):
    wide = ColmapCamera(1, "PINHOLE", 4946, 3286, (4000.0, 4000.0, 2473.0, 1643.0))
    scene = load(colmap_scene("mipnerf360/garden", names=["a.png", "b.png"], camera=wide, picture_size=(4946, 3286)))
    camera = scene.train[0].camera
    assert (camera.width, camera.height) == (1600, 1063)
    assert camera.fov_x == pytest.approx(2 * math.atan(4946 / 8000))
    assert scene.protocol.name == "survey"


def test_what_was_changed_by_hand_is_named_by_what_it_is(mipnerf360, load):
    root = mipnerf360()
    assert load(root, images="images_4").protocol.name == "inria"
    assert load(root, images="images", protocol="inria").protocol.name == "survey"
    for change in (
        {"images": "images_8"}, {"resolution": 4}, {"test_every": 4}, {"split": "all"}, {"background": "white"},
        {"principal_point": "file"},
    ):  # fmt: skip
        assert load(root, **change).protocol.name == "custom", change
    assert load(root, test_every=8, resolution=-1, background="black").protocol.name == "survey"


def test_a_folder_that_the_protocol_wants_and_that_is_not_there_is_named(colmap_scene, load):
    with pytest.raises(SceneError, match="picture folder 'images_4' is missing; there is images"):
        load(f"mipnerf360:{colmap_scene('360_v2/garden')}", protocol="inria")


def test_a_scene_that_nobody_published_is_read_with_a_warning_and_is_custom(colmap_scene, load):
    scene = load(f"mipnerf360:{colmap_scene('mine/gardn')}")
    assert scene.warnings == ["'gardn' is not a published scene of Mip-NeRF 360 (did you mean 'garden'?)"]
    assert scene.protocol.name == "custom"


def test_a_forced_collection_says_what_it_misses(tmp_path, load):
    with pytest.raises(SceneError, match=r"no sparse/0/cameras\.bin.*run COLMAP.*not a scene of Deep Blending"):
        load(f"db:{tmp_path}")
    with pytest.raises(SceneError, match=r"neither sparse/0/cameras\.bin .* nor poses_enu\.json"):
        load(f"bungee:{tmp_path}")


def test_every_picture_of_a_mixed_bag_is_read_at_its_own_size_with_its_own_camera(mipnerf360, load):
    """Sizes, cameras and principal points differ; names have spaces, accents, dots and folders; modes are mixed."""
    cameras = [
        ColmapCamera(1, "PINHOLE", 32, 24, (30.0, 31.0, 16.0, 12.0)),
        ColmapCamera(7, "SIMPLE_PINHOLE", 40, 20, (25.0, 23.5, 10.0)),
        ColmapCamera(3, "OPENCV", 24, 32, (50.0, 52.0, 12.0, 15.5, 0.0, 0.0, 0.0, 0.0)),
    ]
    names = ["left/001.png", "right/001.png", "a b.png", "a.b.png", "ünï/ço dé.png", "z.png"]
    root = mipnerf360(names=names, camera=cameras[0], more_cameras=cameras[1:])
    ramp = np.arange(0, 65536, 65536 / (24 * 32)).astype(np.uint16)
    Image.fromarray(ramp.reshape(24, 32)).save(root / "images" / "left/001.png")  # 16-bit grey, camera 1
    Image.new("LA", (40, 20), (77, 128)).save(root / "images" / "right/001.png")  # grey with alpha, camera 7
    Image.new("RGBA", (24, 32), (9, 8, 7, 255)).save(root / "images" / "a b.png")  # camera 3
    Image.new("P", (32, 24)).save(root / "images" / "a.b.png")  # camera 1
    for options in ({}, {"images": "images_2"}, {"resolution": 2}):
        centred, exact = load(root, **options), load(root, principal_point="file", **options)
        scale = 2 if options else 1
        for i, name in enumerate(names):
            (view,) = (v for v in centred.train + centred.test if v.name == name)
            camera, colmap = view.camera, cameras[i % 3]
            focal = colmap.params[:2] if colmap.model != "SIMPLE_PINHOLE" else colmap.params[:1] * 2
            assert (camera.width, camera.height) == (colmap.width / scale, colmap.height / scale)
            assert (camera.fx, camera.fy) == pytest.approx([f / scale for f in focal])
            assert (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2)
            (other,) = (v.camera for v in exact.train + exact.test if v.name == name)
            assert (other.cx, other.cy) == pytest.approx([c / scale for c in colmap.params[-2:]] if i % 3 == 1 else
                                                         [c / scale for c in colmap.params[2:4]])  # fmt: skip
            channels = 4 if name in ("right/001.png", "a b.png") and not options.get("images") else 3
            assert view.pixels.shape == (channels, camera.height, camera.width)
        assert "up to 3.5 px off the image centre" in centred.warnings[-1]
        assert not any("principal point" in line for line in exact.warnings)
    by_name = {view.name: view for view in load(root).train + load(root).test}
    np.testing.assert_array_equal(by_name["left/001.png"].pixels[0].numpy(), (ramp >> 8).reshape(24, 32))
    assert by_name["right/001.png"].pixels[:3].unique().tolist() == [77]
    assert by_name["right/001.png"].mask.all()
    assert by_name["a b.png"].pixels[:, 0, 0].tolist() == [9, 8, 7, 255]


class TestBungeeOwnLayout:
    """images/ and poses_enu.json, no reconstruction."""

    @staticmethod
    def write(root, axes, count=40, **spoilt):
        """Cameras on circles of growing height that look at the origin; returns R [n,3,3] and centres [n,3]."""
        (root / "images").mkdir(parents=True)
        rows, turns, centres = [], [], []
        for i in range(count):
            a, height = 0.7 * i, 1.0 + 0.1 * i
            c = np.array([2 * math.cos(a), 2 * math.sin(a), height])
            forward = -c / np.linalg.norm(c)
            right = np.cross(forward, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right)
            down = np.cross(forward, right)
            columns = {"nerf": (right, -down, -forward), "llff": (down, right, -forward)}[axes]
            matrix = np.stack([*columns, c, [20.0, 30.0, 25.0]], axis=1)  # height, width, focal of the original
            rows.append([*matrix.ravel().tolist(), 0.5, 9.0])
            turns.append(np.stack([right, down, forward]))
            centres.append(c)
            Image.new("RGB", (15, 10), (i, 0, 0)).save(root / "images" / f"{i:04d}.jpeg", quality=95)
        content = {"poses": rows, "scene_scale": 0.1, "scene_origin": [0, 0, 0], "scale_split": [39], **spoilt}
        (root / "poses_enu.json").write_text(json.dumps(content))
        return np.stack(turns), np.stack(centres)

    @pytest.mark.parametrize("axes", ["nerf", "llff"])
    def test_cameras_are_those_of_the_file_whichever_way_it_orders_their_axes(self, tmp_path, load, axes):
        R, centres = self.write(tmp_path / "Transamerica", axes)
        scene = load(tmp_path / "Transamerica", init_points=2000)
        views = scene.test + scene.train  # lod:30: the first 31 are tested
        assert [v.name for v in views] == [f"{i:04d}.jpeg" for i in range(40)]
        assert len(scene.test) == 31
        for view, R_i, centre in zip(views, R, centres, strict=True):
            torch.testing.assert_close(view.camera.R.double(), torch.from_numpy(R_i), atol=1e-6, rtol=0)
            torch.testing.assert_close(view.camera.center.double(), torch.from_numpy(centre), atol=1e-5, rtol=0)
            assert (view.camera.fx, view.camera.fy) == (12.5, 12.5)  # the picture is half as large as the pose says
        assert scene.protocol.id == "bungee/images/r-1/lod:30/black/pp-center/q8"
        assert "brings no points: 2,000 random ones" in scene.warnings[0]

    def test_start_points_lie_in_sight_about_where_the_cameras_look(self, tmp_path, load):
        self.write(tmp_path / "s", "nerf")
        scene = load(tmp_path / "s", init_points=3000)
        seen = torch.zeros(3000, dtype=torch.bool)
        for view in scene.train + scene.test:
            c = view.camera
            x = scene.points.xyz @ c.R.T + c.tau
            u, v = c.fx * x[:, 0] / x[:, 2] + c.cx, c.fy * x[:, 1] / x[:, 2] + c.cy
            seen |= (x[:, 2] > 0) & (u > -1e-3) & (u < c.width + 1e-3) & (v > -1e-3) & (v < c.height + 1e-3)
        assert seen.all()
        assert scene.points.xyz.median(dim=0).values.abs().max() < 0.3
        again, other = load(tmp_path / "s", init_points=3000), load(tmp_path / "s", init_points=3000, seed=1)
        assert torch.equal(again.points.xyz, scene.points.xyz)
        assert not torch.equal(other.points.xyz, scene.points.xyz)

    def test_the_archive_with_points_goes_first_where_both_layouts_are(self, colmap_scene, load):
        root = colmap_scene("bungee/rome", names=[f"{i:03d}.png" for i in range(40)])
        (root / "poses_enu.json").write_text("{}")
        assert len(load(root).points) == 5

    @pytest.mark.parametrize(
        ("spoilt", "message"),
        [
            ({"poses": []}, "not a list of rows of 17 numbers"),
            ({"poses": [[1.0] * 16]}, "not a list of rows of 17 numbers"),
            ({"poses": [[1.0] * 17, [1.0] * 15]}, "not a list of rows of 17 numbers"),
            ({"poses": {"a": 1}}, "not a list of rows of 17 numbers"),
            ({"poses": [[1.0] * 17]}, "1 poses, images has 40 pictures"),
            ({"poses": [[1.0] * 17] * 40}, "are not a rotation"),
            ({"poses": [[math.nan] * 17] * 40}, "row 0 is not finite"),
            ({"poses": [[1, 0, 0, 5, 9, 0, 1, 0, 5, 9, 0, 0, 1, 5, 9, 0, 1]] * 40}, "15x10 px, its camera is 9x9"),
            ({"poses": [[1, 0, 0, 5, 0, 0, 1, 0, 5, 9, 0, 0, 1, 5, 9, 0, 1]] * 40}, "height, width, focal"),
            ({"poses": [[1, 0, 0, 5, 9, 0, 1, 0, 5, 9, 0, 0, -1, 5, 9, 0, 1]] * 40}, "mirrored"),
        ],
    )
    def test_a_broken_file_is_one_clear_line(self, tmp_path, load, spoilt, message):
        self.write(tmp_path / "s", "nerf", **spoilt)
        with pytest.raises(SceneError, match=message) as caught:
            load(tmp_path / "s")
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("text", ["", "[", "[1]", "null", "[" * 100_000])
    def test_what_is_no_such_json_is_one_clear_line(self, tmp_path, load, text):
        self.write(tmp_path / "s", "nerf")
        (tmp_path / "s" / "poses_enu.json").write_text(text)
        with pytest.raises(SceneError, match=r"poses_enu\.json: "):
            load(tmp_path / "s")


class TestNerfSynthetic:
    """transforms_{train,val,test}.json beside train/, val/, test/ with RGBA pictures, and depth and normal maps."""

    @pytest.fixture
    def chair(self, tmp_path):
        def write(train=100, test=200, home="nerf_synthetic"):
            root = tmp_path / home / "chair"
            for part, count in (("train", train), ("val", 2), ("test", test)):
                (root / part).mkdir(parents=True)
                frames = []
                for i in range(count):
                    pose = np.eye(4)
                    pose[:3, 3] = (0.01 * i, 0.0, 4.0)
                    frames.append({"file_path": f"./{part}/r_{i}", "rotation": 0.1, "transform_matrix": pose.tolist()})
                    Image.new("RGBA", (8, 8), (50, 60, 70, 0 if i else 255)).save(root / part / f"r_{i}.png")
                    if part == "test":
                        Image.new("RGBA", (8, 8)).save(root / part / f"r_{i}_depth_0001.png")
                (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": 0.69, "frames": frames}))
            return root

        return write

    def test_it_is_read_by_its_rules(self, chair, load):
        scene = load(chair())
        assert scene.protocol.id == "nerf_synthetic/rgba/r-1/file/white/pp-center/q8"
        assert scene.protocol.name == "survey"
        assert (len(scene.train), len(scene.test)) == (100, 200)
        assert scene.warnings == []
        assert scene.test[1].image(scene.background).min() == 1.0  # all transparent
        assert scene.test[0].image(scene.background)[:, 0, 0].tolist() == pytest.approx([50 / 255, 60 / 255, 70 / 255])

    def test_black_is_another_protocol(self, chair, load):
        scene = load(chair(), background="black")
        assert scene.protocol.id == "nerf_synthetic/rgba/r-1/file/black/pp-center/q8"
        assert scene.protocol.name == "custom"
        assert scene.test[1].image(scene.background).max() == 0.0

    def test_its_files_prove_the_name(self, chair, load):
        assert load(chair(home="elsewhere")).protocol.dataset == "nerf_synthetic"

    def test_a_thinned_copy_is_not_passed_off_as_the_published_scene(self, chair, load):
        scene = load(chair(train=60, test=20))
        assert "has 100 training and 200 test views a scene, this folder 60 and 20" in scene.warnings[0]

    def test_a_picture_folder_cannot_be_chosen(self, chair, load):
        with pytest.raises(ConfigError, match="--images images_2: there is no picture folder to choose"):
            load(chair(train=2, test=2), images="images_2")


def test_the_demo_has_no_picture_folder_to_choose(load):
    with pytest.raises(ConfigError, match=r"--images images_2: .* family 'demo'; leave it out"):
        load("demo:tiny", images="images_2")


def test_an_option_that_changes_nothing_is_said_to_be_of_no_use(load, colmap_scene):
    assert load("demo:tiny", init_points=7).warnings == [
        "init_points = 7 is of no use for a scene of the family 'demo'"
    ]
    root = colmap_scene("mine/a")
    for key, value in {"protocol": "inria", "legacy_8bit_composite": True}.items():
        told = load(root, **{key: value}).warnings
        assert told == [f"{key} = {value} is of no use for a scene of the family 'colmap'"]


def test_two_splits_at_once_are_refused(load):
    with pytest.raises(ConfigError, match="split = all contradicts test_every = 4"):
        load("demo:tiny", split="all", test_every=4)
    assert load("demo:tiny", split="every4", test_every=4).protocol.split == "every4"


def test_test_every_goes_before_a_collections_own_split(colmap_scene, load):
    root = colmap_scene("bungee/rome", names=[f"{i:03d}.png" for i in range(40)])
    assert load(root, test_every=5).protocol.split == "every5"
    assert len(load(root, test_every=5).test) == 8


class TestDataFolder:
    """dataset/scene below $SPLATWIZARD_DATA."""

    @pytest.fixture
    def data(self, tmp_path, colmap_scene, monkeypatch):
        colmap_scene("data/360_v2/garden")
        colmap_scene("data/360_v2/room")
        colmap_scene("data/tandt/truck")
        monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "data"))
        monkeypatch.chdir(tmp_path)
        return tmp_path / "data"

    def test_a_collection_is_found_under_the_name_of_its_archive(self, data, load):
        for spec in ("mipnerf360/garden", "360_v2/garden"):
            scene = load(spec)
            assert scene.protocol.dataset == "mipnerf360"
            assert Path(scene.path) == data / "360_v2" / "garden"

    def test_a_missing_scene_lists_what_is_there_and_the_nearest(self, data, load):
        with pytest.raises(
            SceneError, match=r"'mipnerf360/gardn' is not there.*did you mean 'garden'\? .*garden, room"
        ):
            load("mipnerf360/gardn")
        with pytest.raises(SceneError, match=r"'tandt/xyz' is not there, nor is .*tandt/xyz: In .*tandt: truck$"):
            load("tandt/xyz")

    def test_a_missing_dataset_lists_what_is_there_and_the_nearest(self, data, load):
        with pytest.raises(SceneError, match=r"nor is .*tandd/truck: did you mean 'tandt'\? In .*data: 360_v2, tandt$"):
            load("tandd/truck")

    def test_a_scene_without_its_dataset_is_answered_with_the_full_name(self, data, load):
        with pytest.raises(SceneError, match=r"'truck' is not there: did you mean tandt/truck \(below \$SPLATWIZ"):
            load("truck")

    def test_an_empty_or_missing_root_is_named(self, data, load, monkeypatch, tmp_path):
        (tmp_path / "empty").mkdir()
        monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "empty"))
        with pytest.raises(SceneError, match=r"there is no folder in .*empty"):
            load("tandt/truck")
        monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "gone"))
        with pytest.raises(SceneError, match=r"\$SPLATWIZARD_DATA names no folder: .*gone"):
            load("tandt/truck")
        monkeypatch.delenv("SPLATWIZARD_DATA")
        with pytest.raises(SceneError, match=r"\$SPLATWIZARD_DATA is not set"):
            load("tandt/truck")

    def test_a_path_goes_first(self, data, load, colmap_scene):
        colmap_scene("tandt/truck", names=["a.png", "b.png"])
        assert len(load("tandt/truck").train) == 1

    def test_a_dataset_of_ones_own_gives_its_name_to_the_protocol(self, data, load, colmap_scene):
        colmap_scene("data/holiday/beach")
        assert load("holiday/beach").protocol.id.startswith("holiday/images/")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root reads every folder")
    def test_a_folder_that_cannot_be_listed_is_not_a_traceback(self, data, load):
        (data / "tandt").chmod(0)
        try:
            with pytest.raises(SceneError, match="is not there"):
                load("tandt/truck")
        finally:
            (data / "tandt").chmod(0o755)


def test_the_registry_of_public_data_and_the_rules_name_the_same_scenes():
    for name, dataset in load_registry().items():
        if name in BENCHMARKS:
            family = BENCHMARKS[name]
            assert set(dataset.scenes) <= set(family.scenes), name
            assert (dataset.prefix, dataset.views) == (family.prefix, family.views)


def test_entries_declare_the_scenes_that_published_tables_report():
    declared = {entry.name: entry.declared for entry in load_plugins().datasets}
    assert declared["bungee"]["table_scenes"] == ["amsterdam", "bilbao", "hollywood", "pompidou", "quebec", "rome"]
    assert {"56Leonard", "Transamerica"} < set(declared["bungee"]["scenes"])
    for name in BENCHMARKS.keys() - {"bungee"}:
        assert declared[name]["table_scenes"] == declared[name]["scenes"]
