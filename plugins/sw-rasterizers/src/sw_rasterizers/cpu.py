"""Drawing on the CPU: memory for the operations of csrc/cpu/face.h, and their order."""

from __future__ import annotations

import functools
import os
from collections.abc import Collection
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sw_rasterizers import face
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES, Call, Flag
from sw_rasterizers.memory import empty

MOST_PAIRS = 1 << 27
"""Pairs of a splat and a tile that a call may have: four times those of the largest real scenes."""
LIMIT = "SPLATWIZARD_MAX_TILE_PAIRS"

INVERSE_DEPTH, ACCUMULATED_DEPTH, MEDIAN_DEPTH, ALPHA_MAP, SAVE, WITH_MAPS = map(int, (
    Flag.INVERSE_DEPTH, Flag.ACCUMULATED_DEPTH, Flag.MEDIAN_DEPTH, Flag.ALPHA_MAP, Flag.SAVE, Flag.WITH_MAPS
))  # fmt: skip
"""As numbers, which Python combines several times as fast."""

Arguments = dict[str, Any]
Tensors = dict[str, Any]
"""Tensors or None, by the names that the operations have for them."""


class Kept(NamedTuple):
    """State of a drawing that its backward pass needs.

    splats, lists   bytes, in tensors
    pairs           of a splat and a tile
    sum_bytes       what the backward pass needs for its sums
    """

    splats: Tensor
    lists: Tensor
    pairs: int
    sum_bytes: int


class Drawn(NamedTuple):
    """image [C,H,W], radii [N] int32; where they are asked for alpha, median depth [1,H,W], maps of surfels [7,H,W]."""

    image: Tensor
    radii: Tensor
    alpha: Tensor | None
    median: Tensor | None
    maps: Tensor | None
    kept: Kept


class Projected(NamedTuple):
    """Results of `project`: bytes, tiles of all pairs, radii, counts."""

    splats: Tensor
    tiles: Tensor
    radii: Tensor
    found: face.project_call


class Picture:
    """A view and what it is drawn with, as the operations take it; holds no tensor to differentiate by.

    channels    of the image: colours, depths, features
    """

    def __init__(self, call: Call, tensors: Tensors, flags: int) -> None:
        colors, features, background = tensors["colors"], tensors.get("features"), call.background
        self.call, self.flags = call, flags
        self.colors = 3 if colors is None else colors.shape[1]
        self.depths = bool(flags & INVERSE_DEPTH) + bool(flags & ACCUMULATED_DEPTH)
        self.channels = self.colors + self.depths + (0 if features is None else features.shape[1])
        self.size = call.height, call.width
        self.view: Arguments = {"camera": call.camera, "width": call.width, "height": call.height, "flags": flags}
        self.how: Arguments = {
            "sh_degree": call.sh_degree, "scale_modifier": call.scale_modifier, "eps2d": call.eps2d
        }  # fmt: skip
        behind = "background" if background is None or background.dim() == 1 else "backdrop"
        self.canvas: Arguments = {"channels": self.channels, "color_channels": self.colors, behind: background}

    def settings(self) -> Arguments:
        """Return all of it but the camera."""
        found = {**self.view, **self.how, **self.canvas}
        del found["camera"]
        return found

    def empty_image(self, dtype: torch.dtype) -> Tensor:
        """Return an image without its pixels."""
        return empty((self.channels, *self.size), dtype)


class _Listed:
    """Number of pairs of recent calls: a guess at that of the next one."""

    recent = 0


def draw(picture: Picture, tensors: Tensors) -> Drawn:
    """Draw one view; `tensors` by the names of INPUTS, contiguous. Fills counts and seconds of the call.

    Raises RuntimeError for tensors that do not fit together, and for more pairs than are allowed.
    """
    call, flags, means = picture.call, picture.flags, tensors["means"]
    assert means is not None
    projected = project(picture, tensors, training=bool(flags & SAVE))
    found, dtype = projected.found, means.dtype
    image = picture.empty_image(dtype)
    alpha = empty((1, *picture.size), dtype) if flags & ALPHA_MAP else None
    median = empty((1, *picture.size), dtype) if flags & MEDIAN_DEPTH else None
    maps = empty((7, *picture.size), dtype) if flags & WITH_MAPS else None
    made, lists = make_lists(picture, projected, image, alpha=alpha, median=median, maps=maps)
    call.counts = [found.seen, found.pairs, made.evaluated, made.blended, found.invalid]
    seconds = found.project_seconds, made.sort_seconds, made.bin_seconds, made.blend_seconds
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=True))
    kept = Kept(projected.splats, lists, found.pairs, found.sum_bytes)
    return Drawn(image, projected.radii, alpha, median, maps, kept)


def project(picture: Picture, tensors: Tensors, *, training: bool = False) -> Projected:
    """Project the Gaussians of one view. In training half as many pairs are allowed. Raises as `draw`."""
    call, means = picture.call, tensors["means"]
    assert means is not None
    count, colors = len(means), picture.colors
    bytes_of = _splat_bytes(means.element_size(), count, picture.flags, picture.channels, colors, call.sh_degree)
    splats, radii = empty((bytes_of,), torch.uint8), torch.empty(count, dtype=torch.int32)
    most = most_pairs() // (2 if training else 1)
    room = min(most, max(4 * count + (1 << 14), _Listed.recent + _Listed.recent // 4))
    while True:
        tiles = empty((room,), torch.int32)
        found = face.project(
            **tensors, geom_indices=call.geom_indices, visible=call.visible, count=count, color_channels=colors,
            splats=splats, tiles=tiles, radii=radii, **picture.view, **picture.how,
        )  # fmt: skip
        if found.listed > most:
            raise RuntimeError(
                f"sw_rasterizers: {found.listed} splat-tile pairs are more than {most}: draw fewer Gaussians or a "
                f"smaller image, or set {LIMIT} (13 bytes each, 70 in training, which takes half as many)"
            )
        _Listed.recent = max(found.listed, _Listed.recent - _Listed.recent // 64)
        if found.listed <= room:
            return Projected(splats, tiles, radii, found)
        room = found.listed


def make_lists(
    picture: Picture, projected: Projected, image: Tensor | None, **maps: Any
) -> tuple[face.draw_call, Tensor]:
    """List the splats of each tile and draw them, where there is an image; return what was told, and the lists."""
    splats, tiles, radii, found = projected
    lists = empty((found.list_bytes,), torch.uint8)
    made = face.draw(
        real_bytes=found.real_bytes, splats=splats, tiles=tiles, count=len(radii), used=found.used, pairs=found.pairs,
        lists=lists, image=image, **maps, **picture.view, **picture.canvas,
    )  # fmt: skip
    return made, lists


def draw_backward(
    picture: Picture, tensors: Tensors, kept: Kept, by: Tensors, wanted: Collection[str]
) -> dict[str, Tensor]:
    """Return the gradients that are wanted, by name of the input, or "grad2d" and "absgrad2d" [N,2].

    by      gradients of "image", and of "alpha", "median", "maps" or None; contiguous
    """
    call, means = picture.call, tensors["means"]
    assert means is not None
    made: Tensors = {name: empty(x.shape, x.dtype) for name, x in tensors.items() if name in wanted and x is not None}
    made |= {name: empty((len(means), 2), means.dtype) for name in ("grad2d", "absgrad2d") if name in wanted}
    found = face.draw_backward(
        **tensors, geom_indices=call.geom_indices, visible=call.visible, splats=kept.splats, lists=kept.lists,
        pairs=kept.pairs, sums=empty((kept.sum_bytes,), torch.uint8),
        **{f"by_{name}": x for name, x in by.items()}, **{f"of_{name}": x for name, x in made.items()},
        **picture.view, **picture.how, **picture.canvas,
    )  # fmt: skip
    call.seconds.update(zip(BACKWARD_STAGES, (found.blend_seconds, found.project_seconds), strict=True))
    return made


def visible_radii(call: Call, geometry: Tensors) -> Tensor:
    """Return radii [N] int32, px, from means, scales, quats, cov3d and scale_factors; 0 = culled."""
    means = geometry["means"]
    assert means is not None
    radii = torch.empty(len(means), dtype=torch.int32)
    face.visible_radii(
        **geometry, geom_indices=call.geom_indices, visible=call.visible, radii=radii, camera=call.camera,
        width=call.width, height=call.height, flags=int(call.flags), scale_modifier=call.scale_modifier,
        eps2d=call.eps2d,
    )  # fmt: skip
    return radii


@functools.lru_cache(maxsize=64)
def _splat_bytes(real_bytes: int, count: int, flags: int, channels: int, colors: int, sh_degree: int) -> int:
    found = face.plan_splats(
        real_bytes=real_bytes, count=count, flags=flags, channels=channels, color_channels=colors, sh_degree=sh_degree
    )
    return found.splat_bytes


def most_pairs() -> int:
    """Pairs that a call may have; a file of a kilobyte can ask for any number of them."""
    asked = os.environ.get(LIMIT, "")
    return min(int(asked) if asked.isdigit() and int(asked) else MOST_PAIRS, (1 << 31) - 1)
