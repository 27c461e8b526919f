"""Checks that the pictures of every scene pass: size against camera, EXIF turns, alpha and masks.

A loader asks it for each view; what was found stands in `warnings` once all views are made.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from splatwizard_core.api import Camera, SceneError, View
from sw_datasets.pictures import (
    UPRIGHT,
    Header,
    fitted_size,
    load_composited,
    load_cut_out,
    load_mask,
    load_picture,
    read_header,
)
from sw_datasets.rules import Rules

MAX_ASPECT_ERROR = 0.01
"""Share by which the scales of a picture in x and y may differ, beyond rounding to whole pixels, and be but told."""
MAX_CENTER_OFFSET = 0.25
"""Share of the picture's side by which a principal point off the centre is told whatever the rules say."""
ROTATED_90 = range(5, 9)
"""EXIF orientations that swap width and height."""


@dataclass(frozen=True)
class Picture:
    """A picture file that was let in.

    width, height   pixels, after the turn
    turn            EXIF orientation that is applied; 1: none
    """

    file: Path
    width: int
    height: int
    has_alpha: bool
    turn: int = UPRIGHT


class Gate:
    """Lets the pictures of one scene in, and makes its views.

    scene           folder, for messages
    rules           that the scene is read by
    always_cut      alpha is composited whatever `mask_background` says (Blender)
    quiet_masks     masks that are not applied to pictures serve elsewhere, and are not told (DTU)
    """

    def __init__(self, scene: Path, rules: Rules, *, always_cut: bool = False, quiet_masks: bool = False) -> None:
        self.scene, self.rules = scene, rules
        self.always_cut, self.quiet_masks = always_cut, quiet_masks
        self.off_centre = 0.0
        self.cut = Counter[str]()
        self.seen = Counter[str]()
        self._unlike: tuple[float, str] = (0.0, "")
        self._odd_mask = self._far_off = ""

    def admit(self, name: str, file: Path, camera_size: tuple[int, int] | None) -> Picture:
        """Hold a picture against the size (width, height) that its camera was made for; None: the scene does not say.

        Raises SceneError for a picture of another shape than its camera.
        """
        header = read_header(file)
        turn = self._turn(header, name, camera_size)
        width, height = _turned(header, turn)
        return Picture(file, width, height, header.has_alpha, turn)

    def _turn(self, header: Header, name: str, camera_size: tuple[int, int] | None) -> int:
        stored, said = (header.width, header.height), header.orientation
        upright = _turned(header, said)
        if camera_size is None or same_shape(stored, camera_size):
            # A camera that fits the stored pixels alone was made from them; one that fits both does not say.
            unsure = said != UPRIGHT and (camera_size is None or same_shape(upright, camera_size))
            self.seen["unsure turn"] += unsure
            return said if unsure and self.rules.exif_turn else UPRIGHT
        if said != UPRIGHT and same_shape(upright, camera_size):
            self.seen["turned"] += 1
            return said
        (w, h), (cw, ch) = stored, camera_size
        stretch = abs((w / cw) / (h / ch) - 1)
        if stretch <= MAX_ASPECT_ERROR:
            self.seen["stretched"] += 1
            if stretch > self._unlike[0]:
                self._unlike = stretch, f"'{name}' is {w}x{h} px, its camera {cw}x{ch}"
            return UPRIGHT
        reason = "its sides are swapped: it was turned" if same_shape((h, w), camera_size) else "it was cropped"
        also = "" if said == UPRIGHT else f" (EXIF orientation {said} makes it {upright[0]}x{upright[1]})"
        raise SceneError(
            f"{self.scene}: image '{name}' is {w}x{h} px{also}, its camera is {cw}x{ch}: they differ in aspect; "
            f"{reason} or stretched after the poses were made: use the pictures that they were made from",
            path=str(self.scene),
        )

    def view(self, name: str, picture: Picture, camera: Camera, mask: Path | None = None) -> View:
        """Make a view, at the size that the resolution rule gives.

        camera  with the principal point of the file, at any size of the same field of view
        mask    picture of what is kept; None: the picture's own alpha, if any

        Raises SceneError where `mask_background` is asked for and there is nothing to cut by.
        """
        rules, file, turn = self.rules, picture.file, picture.turn
        size = fitted_size(picture.width, picture.height, rules.resolution)
        off = max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
        self.off_centre = max(self.off_centre, off)
        if (
            abs(camera.cx / camera.width - 0.5) > MAX_CENTER_OFFSET
            or abs(camera.cy / camera.height - 0.5) > MAX_CENTER_OFFSET
        ):
            self._far_off = self._far_off or name
        if rules.principal_point != "file":
            camera = _centred(camera)
        cut_by_alpha = picture.has_alpha and (self.always_cut or rules.cuts_alpha)
        cut_by_mask = rules.masked is True and not picture.has_alpha
        mask_turn = UPRIGHT
        if mask is not None:
            try:
                mask_turn = self._mask_turn(name, mask, picture)
            except SceneError as error:
                if cut_by_mask or self.quiet_masks:
                    raise
                self._odd_mask = self._odd_mask or str(error).removeprefix(f"{self.scene}: ")
                self.seen["odd masks"] += 1
                mask = None
        load = partial(load_picture, file, size, alpha=cut_by_alpha, turn=turn)
        if cut_by_mask:
            if mask is None:
                raise SceneError(
                    f"{self.scene}: mask_background needs a mask for every image, and '{name}' has neither alpha nor "
                    "a file in masks/",
                    path=str(self.scene),
                )
            load = partial(load_cut_out, file, mask, size, turn=turn, mask_turn=mask_turn)
        elif cut_by_alpha and rules.composite8:
            load = partial(load_composited, file, size, 0 if rules.background == "black" else 255, turn=turn)
        self.seen["masks"] += mask is not None and not cut_by_mask
        self.cut["alpha"] += cut_by_alpha
        self.cut["mask"] += cut_by_mask
        self.seen["unused alpha"] += picture.has_alpha and not cut_by_alpha
        masked_by = None
        if mask is not None:
            masked_by = partial(load_mask, mask, size, turn=mask_turn)
        elif picture.has_alpha:
            masked_by = partial(load_mask, file, size, turn=turn)
        # The field of view is that of the camera's own size, whatever the size of the file: focal lengths scale along.
        return View(camera.resized(*size), name, load, masked_by)

    def _mask_turn(self, name: str, mask: Path, picture: Picture) -> int:
        header, size = read_header(mask), (picture.width, picture.height)
        if same_shape((header.width, header.height), size):
            return UPRIGHT
        for turn in (header.orientation, picture.turn):
            if turn != UPRIGHT and same_shape(_turned(header, turn), size):
                return turn
        raise SceneError(
            f"{self.scene}: the mask {mask.name} is {header.width}x{header.height} px, its image '{name}' "
            f"{picture.width}x{picture.height}: they differ in aspect",
            path=str(self.scene),
        )

    @property
    def masked(self) -> bool:
        """Whether pictures were cut out, beyond what the layout always does."""
        return bool(self.cut["mask"] or (self.cut["alpha"] and not self.always_cut))

    @property
    def turned(self) -> bool:
        """Whether pictures were turned because the user said so."""
        return bool(self.seen["unsure turn"] and self.rules.exif_turn)

    def warnings(self) -> list[str]:
        """List what was done, and what was found and not used, a line each."""
        seen, background = self.seen, self.rules.background
        found = []
        if count := seen["turned"]:
            found.append(f"{count} pictures are turned by their EXIF orientation, as the size of their cameras says")
        if (count := seen["unsure turn"]) and self.rules.exif_turn is None:
            found.append(
                f"{count} pictures have an EXIF orientation, which is not applied: the size of their cameras does not "
                "say whether the poses were made from turned pictures (exif_turn = true turns them, false leaves them)"
            )
        if count := seen["stretched"]:
            found.append(f"{count} pictures differ from their cameras in aspect, the most: {self._unlike[1]}")
        if (count := self.cut["alpha"]) and not self.always_cut and self.rules.masked is None:
            found.append(
                f"{count} pictures have alpha: they are composited on {background} "
                "(mask_background = false takes their colours as they are)"
            )
        if (count := seen["unused alpha"]) and not self.quiet_masks and self.rules.masked is None:
            found.append(f"the alpha of {count} pictures is not used (mask_background = true composites them)")
        if (count := seen["masks"]) and not self.quiet_masks and self.rules.masked is None and not self.cut["alpha"]:
            found.append(
                f"the masks of {count} pictures are not used (mask_background = true cuts the pictures out by them)"
            )
        if count := seen["odd masks"]:
            found.append(f"{count} masks are left out: {self._odd_mask}")
        if self._far_off:
            found.append(
                f"the principal point of '{self._far_off}' lies more than a quarter of the picture off its centre: cx "
                "and cy may be those of a picture of another size (w and h say of which)"
            )
        if self.off_centre > 1 and self.rules.principal_point != "file":
            found.append(
                f"the principal point is up to {self.off_centre:.1f} px off the image centre and is taken as the "
                "centre, as the 3DGS code does (principal_point = file uses it)"
            )
        return found


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size (width, height) is the other at one scale, each side rounded up or down to whole pixels."""
    low = max((a - 1) / b for a, b in zip(size, other, strict=True))
    high = min((a + 1) / b for a, b in zip(size, other, strict=True))
    return low <= high


def _turned(header: Header, turn: int) -> tuple[int, int]:
    return (header.height, header.width) if turn in ROTATED_90 else (header.width, header.height)


def _centred(camera: Camera) -> Camera:
    return replace(camera, cx=camera.width / 2, cy=camera.height / 2)
