"""Pictures of many views: decoded once, checked without being kept."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from splatwizard_core.errors import SceneError
from splatwizard_core.scene import images
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.images import check_pictures, decode_all, decoded_ahead
from splatwizard_core.scene.scene import View

CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, torch.eye(3), torch.zeros(3))


class Pictures:
    """Views that count how often each is decoded."""

    def __init__(self, count: int) -> None:
        self.decoded = [0] * count
        self.masks = 0
        self.views = [View(CAMERA, str(i), self.loader(i), self.load_mask) for i in range(count)]

    def loader(self, i: int):
        def load() -> np.ndarray:
            self.decoded[i] += 1
            return np.full((6, 8, 3), i, np.uint8)

        return load

    def load_mask(self) -> np.ndarray:
        self.masks += 1
        return np.ones((6, 8), bool)


def damaged() -> np.ndarray:
    raise SceneError("b.png: the picture cannot be decoded")


def test_decode_all_decodes_every_view_once():
    pictures = Pictures(5)
    decode_all(pictures.views[:2])
    decode_all([*pictures.views, View(CAMERA, "without a picture")])
    assert pictures.decoded == [1] * 5
    assert [int(view.pixels[0, 0, 0]) for view in pictures.views] == [0, 1, 2, 3, 4]
    assert pictures.masks == 0


@pytest.mark.parametrize("decode", [decode_all, check_pictures, lambda views: list(decoded_ahead(views))])
def test_two_pictures_are_decoded_at_a_time(monkeypatch, decode):
    """Each waits for the other: one after the other none would come."""
    monkeypatch.setattr(images, "available_cores", lambda: 2)
    both = threading.Barrier(2, timeout=60)

    def load() -> np.ndarray:
        both.wait()
        return np.zeros((6, 8, 3), np.uint8)

    decode([View(CAMERA, name, load) for name in "ab"])


@pytest.mark.filterwarnings("error")
def test_a_picture_of_one_pixel_is_not_shared_with_whoever_decoded_it():
    fixed = np.zeros((1, 1, 3), np.uint8)
    fixed.setflags(write=False)  # as Pillow's are
    view = View(CAMERA, "a", lambda: fixed)
    view.pixels.add_(1)
    assert not fixed.any()


def test_checked_pictures_are_not_kept():
    pictures = Pictures(2)
    check_pictures(pictures.views)
    assert (pictures.decoded, pictures.masks) == ([1, 1], 2)
    assert not any("pixels" in vars(view) for view in pictures.views)


def test_pictures_that_are_decoded_ahead_come_in_order_once_and_are_not_kept():
    pictures = Pictures(40)
    decode_all(pictures.views[:2])
    found = [(view.name, int(view.pixels[0, 0, 0])) for view in decoded_ahead(pictures.views)]
    assert found == [(str(i), i) for i in range(40)]
    assert pictures.decoded == [1] * 40
    assert ["pixels" in vars(view) for view in pictures.views] == [True] * 2 + [False] * 38


def test_few_pictures_are_decoded_before_they_are_asked_for():
    pictures = Pictures(40)
    ahead = decoded_ahead(pictures.views)
    next(ahead)
    assert sum(pictures.decoded) <= 9  # one for each of at most 8 threads, and the one that is asked for
    ahead.close()


def test_a_damaged_picture_that_is_decoded_ahead_is_told():
    with pytest.raises(SceneError, match=r"b\.png"):
        list(decoded_ahead([View(CAMERA, "b", damaged)]))


@pytest.mark.parametrize(
    "views", [[View(CAMERA, "b", damaged)], [View(CAMERA, "b", lambda: np.zeros((6, 8, 3), np.uint8), damaged)]]
)
def test_a_damaged_picture_or_mask_is_found_before_it_is_needed(views):
    with pytest.raises(SceneError, match=r"b\.png"):
        check_pictures(views)
