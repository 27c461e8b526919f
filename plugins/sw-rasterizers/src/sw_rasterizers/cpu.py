"""Drawing on the CPU: memory for the operations of csrc/cpu/face.h, and their order."""

from __future__ import annotations

import functools
import os
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sw_rasterizers import face
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES, Call, Flag
from sw_rasterizers.memory import empty

MOST_PAIRS = 1 << 27
"""Pairs of a splat and a tile that a call may have: four times those of the largest real scenes."""
LIMIT = "SPLATWIZARD_MAX_TILE_PAIRS"

Tensors = dict[str, Tensor | None]


class Kept(NamedTuple):
    """What a drawing keeps for its backward pass.

    splats, lists   bytes, in tensors
    pairs           of a splat and a tile
    sum_bytes       what the backward pass needs for its sums
    """

    splats: Tensor
    lists: Tensor
    pairs: int
    sum_bytes: int


@dataclass
class Drawn:
    """image [C,H,W], radii [N] int32, alpha and median depth [0 or 1,H,W], maps of surfels [0 or 7,H,W]."""

    image: Tensor
    radii: Tensor
    alpha: Tensor
    median: Tensor
    maps: Tensor
    kept: Kept


class Projected(NamedTuple):
    """What `project` found: bytes, tiles of all pairs, radii, counts."""

    splats: Tensor
    tiles: Tensor
    radii: Tensor
    found: face.project_call


class _Listed:
    """How many pairs calls had of late: a guess at how many the next one has."""

    recent = 0


def draw(call: Call, tensors: Tensors, flags: Flag) -> Drawn:
    """Draw one view; `tensors` by the names of INPUTS, contiguous. Fills counts and seconds of the call.

    Raises RuntimeError for tensors that do not fit together, and for more pairs than are allowed.
    """
    projected = project(call, tensors, flags, training=Flag.SAVE in flags)
    means, found = tensors["means"], projected.found
    assert means is not None
    size, dtype = (call.height, call.width), means.dtype
    image = empty((channels_of(tensors, flags), *size), dtype)
    alpha = empty((int(Flag.ALPHA_MAP in flags), *size), dtype)
    median = empty((int(Flag.MEDIAN_DEPTH in flags), *size), dtype)
    maps = empty((7 if Flag.WITH_MAPS in flags else 0, *size), dtype)
    made, lists = make_lists(call, tensors, flags, projected, image=image, alpha=alpha, median=median, maps=maps)
    call.counts = [found.seen, found.pairs, made.evaluated, made.blended, found.invalid]
    seconds = found.project_seconds, made.sort_seconds, made.bin_seconds, made.blend_seconds
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=True))
    return Drawn(
        image, projected.radii, alpha, median, maps, Kept(projected.splats, lists, found.pairs, found.sum_bytes)
    )


def project(call: Call, tensors: Tensors, flags: Flag, *, training: bool = False) -> Projected:
    """Project the Gaussians of one view. In training half as many pairs are allowed. Raises as `draw`."""
    means = tensors["means"]
    assert means is not None
    count, colors = len(means), _colors(tensors)
    bytes_of = _splat_bytes(
        means.element_size(), count, int(flags), channels_of(tensors, flags), colors, call.sh_degree
    )
    splats, radii = empty((bytes_of,), torch.uint8), torch.empty(count, dtype=torch.int32)
    most = _most_pairs() // (2 if training else 1)
    room = min(most, max(4 * count + (1 << 14), _Listed.recent + _Listed.recent // 4))
    while True:
        tiles = empty((room,), torch.int32)
        found = face.project(
            **tensors, geom_indices=call.geom_indices, visible=call.visible, count=count, color_channels=colors,
            splats=splats, tiles=tiles, radii=radii, **_view(call, flags), **_how(call),
        )  # fmt: skip
        if found.listed > most:
            raise RuntimeError(
                f"sw_rasterizers: {found.listed} splat-tile pairs are more than {most}: draw fewer Gaussians or a "
                f"smaller image, or set {LIMIT} (12 bytes each, 70 in training, which takes half as many)"
            )
        _Listed.recent = max(found.listed, _Listed.recent - _Listed.recent // 64)
        if found.listed <= room:
            return Projected(splats, tiles, radii, found)
        room = found.listed


def make_lists(
    call: Call, tensors: Tensors, flags: Flag, projected: Projected, image: Tensor | None = None, **maps: Tensor
) -> tuple[face.draw_call, Tensor]:
    """List the splats of each tile and draw them, where there is an image; return what was told, and the lists."""
    found, means = projected.found, tensors["means"]
    assert means is not None
    lists = empty((found.list_bytes,), torch.uint8)
    made = face.draw(
        real_bytes=means.element_size(), splats=projected.splats, tiles=projected.tiles, count=len(means),
        used=found.used, pairs=found.pairs, lists=lists, image=image, **_view(call, flags),
        **canvas(call, tensors, flags), **{name: x for name, x in maps.items() if x.numel()},
    )  # fmt: skip
    return made, lists


def draw_backward(
    call: Call, tensors: Tensors, flags: Flag, kept: Kept, by: Tensors, wanted: Collection[str]
) -> dict[str, Tensor]:
    """Return the gradients that are wanted, by name of the input, or "grad2d" and "absgrad2d" [N,2].

    by      gradients of "image", and of "alpha", "median", "maps" or None; contiguous
    """
    means = tensors["means"]
    assert means is not None
    made = {name: empty(x.shape, x.dtype) for name, x in tensors.items() if name in wanted and x is not None}
    made |= {name: empty((len(means), 2), means.dtype) for name in ("grad2d", "absgrad2d") if name in wanted}
    found = face.draw_backward(
        **tensors, geom_indices=call.geom_indices, visible=call.visible, splats=kept.splats, lists=kept.lists,
        pairs=kept.pairs, sums=empty((kept.sum_bytes,), torch.uint8),
        **{f"by_{name}": x for name, x in by.items()}, **{f"of_{name}": x for name, x in made.items()},
        **_view(call, flags), **_how(call), **canvas(call, tensors, flags),
    )  # fmt: skip
    call.seconds.update(zip(BACKWARD_STAGES, (found.blend_seconds, found.project_seconds), strict=True))
    return made


def visible_radii(call: Call, geometry: Tensors, flags: Flag) -> Tensor:
    """Return radii [N] int32, px, from means, scales, quats, cov3d and scale_factors; 0 = culled."""
    means = geometry["means"]
    assert means is not None
    radii = torch.empty(len(means), dtype=torch.int32)
    face.visible_radii(
        **geometry, geom_indices=call.geom_indices, visible=call.visible, radii=radii,
        scale_modifier=call.scale_modifier, eps2d=call.eps2d, **_view(call, flags),
    )  # fmt: skip
    return radii


def canvas(call: Call, tensors: Tensors, flags: Flag) -> dict[str, Any]:
    """Return the arguments of an operation that say what a picture consists of."""
    behind = "background" if call.background is None or call.background.dim() == 1 else "backdrop"
    return {"channels": channels_of(tensors, flags), "color_channels": _colors(tensors), behind: call.background}


def channels_of(tensors: Tensors, flags: Flag) -> int:
    """Return the channels of the image: colours, depths, features."""
    features = tensors.get("features")
    depths = (Flag.INVERSE_DEPTH in flags) + (Flag.ACCUMULATED_DEPTH in flags)
    return _colors(tensors) + depths + (0 if features is None else features.shape[1])


def _colors(tensors: Tensors) -> int:
    colors = tensors["colors"]
    return 3 if colors is None else colors.shape[1]


def _view(call: Call, flags: Flag) -> dict[str, Any]:
    return {"camera": call.camera, "width": call.width, "height": call.height, "flags": int(flags)}


def _how(call: Call) -> dict[str, Any]:
    return {"sh_degree": call.sh_degree, "scale_modifier": call.scale_modifier, "eps2d": call.eps2d}


@functools.lru_cache(maxsize=64)
def _splat_bytes(real_bytes: int, count: int, flags: int, channels: int, colors: int, sh_degree: int) -> int:
    found = face.plan_splats(
        real_bytes=real_bytes, count=count, flags=flags, channels=channels, color_channels=colors, sh_degree=sh_degree
    )
    return found.splat_bytes


def _most_pairs() -> int:
    """Pairs that a call may have; a file of a kilobyte can ask for any number of them."""
    asked = os.environ.get(LIMIT, "")
    return min(int(asked) if asked.isdigit() and int(asked) else MOST_PAIRS, (1 << 31) - 1)
