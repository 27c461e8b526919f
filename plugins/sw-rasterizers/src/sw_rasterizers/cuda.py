"""Drawing on CUDA: memory for the operations of csrc/cuda/face.h, and their order."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import torch
from torch import Tensor

from splatwizard_native import AdamUpdate, NativeBuildError, Repeated
from sw_rasterizers import cuda_face
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES, Call, Flag
from sw_rasterizers.cpu import (
    ALPHA_MAP,
    LIMIT,
    MEDIAN_DEPTH,
    SAVE,
    WITH_MAPS,
    Picture,
    Tensors,
    most_pairs,
)
from sw_rasterizers.native import MODULE, unavailable_on_cuda

BYTES, COUNT, FOR_SCORES, ORDERED = map(int, (Flag.BYTES, Flag.COUNT, Flag.FOR_SCORES, Flag.ORDERED))
NUMBERED = (1 << 31) - 1025
"""Pairs that have a number: the kernels look up to three stages of 256 ahead of the last one, in 32 bits."""


class Kept(NamedTuple):
    """State of a drawing that its backward pass and scores need.

    lists, pair_splats      opaque memory, and the splat of each pair
    drawn                   flags [N] of the Gaussians
    sizes                   room and counts, as the operations take them
    """

    lists: Tensor
    pair_splats: Tensor
    drawn: Tensor
    sizes: dict[str, int]


class Drawn(NamedTuple):
    """image [C,H,W], radii [N] int32; where they are asked for alpha, median depth [1,H,W], maps of surfels [7,H,W]."""

    image: Tensor
    radii: Tensor
    alpha: Tensor | None
    median: Tensor | None
    maps: Tensor | None
    kept: Kept | None


class _Recent:
    """Numbers of splats and pairs of recent calls: a guess at those of the next one."""

    splats = pairs = 0


class _Mailboxes(threading.local):
    """Pinned memory of a thread for each GPU, into which the device writes its counts."""

    def __init__(self) -> None:
        self.of: dict[int, Tensor] = {}

    def address(self, device: int) -> int:
        if device not in self.of:
            self.of[device] = torch.empty(16, dtype=torch.int64, pin_memory=True)
        return self.of[device].data_ptr()


_MAILBOXES = _Mailboxes()


def check() -> None:
    """Raise NativeBuildError where there are no kernels for a GPU."""
    if not MODULE.has_cuda():
        raise NativeBuildError(str(unavailable_on_cuda()))


Again = dict[str, Repeated]
"""Operations of drawings that are alike: of one size, with one background, of tensors that differ in rows alone."""


def again() -> Again:
    """Return what a first drawing fills for those that are like it."""
    return {name: Repeated(cuda_face, name) for name in ("render", "blend_backward", "project_backward")}


def draw(picture: Picture, tensors: Tensors, again: Again | None = None) -> Drawn:
    """Draw one view; `tensors` by the names of INPUTS, contiguous. Fills counts of the call, and seconds if it counts.

    Memory for splats and pairs is that of recent calls and an eighth more, so that the device need not wait for the
    host once it has counted; where that is not enough, a second call goes on with what there is.
    Raises RuntimeError for tensors that do not fit together, and for more pairs than are allowed.
    """
    check()
    call, flags, means = picture.call, picture.flags, tensors["means"]
    count, device, most = means.shape[0], means.get_device(), min(most_pairs(), NUMBERED)
    splat_room = min(count, _rounded(_Recent.splats))
    room = min(most, _rounded(max(_Recent.pairs, 1)))
    real, byte = means.new_empty, functools.partial(means.new_empty, dtype=torch.uint8)
    shape, plane = (picture.channels, *picture.size), (1, *picture.size)
    as_bytes = bool(flags & BYTES)
    image = byte(shape) if as_bytes else real(shape)
    alpha = real(plane) if flags & ALPHA_MAP else None
    median = real(plane) if flags & MEDIAN_DEPTH else None
    maps = real((7, *picture.size)) if flags & WITH_MAPS else None
    radii = means.new_empty(count, dtype=torch.int32)
    drawn = byte(count) if flags & SAVE else None
    splats, seconds, camera = None, 0.0, tuple(call.camera)

    def fixed() -> dict[str, Any]:
        return {"geom_indices": call.geom_indices, "visible": call.visible, "device": device, **picture.settings()}

    while True:
        sizes = _plan(device, count, splat_room, room, *picture.size, picture.channels, picture.colors, flags)
        projected = splats is not None
        splats = byte(sizes.splat_bytes) if splats is None else splats
        lists = byte(sizes.list_bytes)
        scratch = byte(sizes.scratch_bytes)
        pair_splats = means.new_empty(room, dtype=torch.int32), means.new_empty(room, dtype=torch.int32)
        # What is made here fits: addresses spare its checks, each as long as making it.
        render = _once(cuda_face.render) if again is None else again["render"]
        found = render(
            fixed, **_rows(count, again), **{name: x for name, x in tensors.items() if x is not None}, camera=camera,
            projected=projected, mailbox=_MAILBOXES.address(device), splats=splats.data_ptr(),
            splat_bytes=splats.numel(), scratch=scratch.data_ptr(), scratch_bytes=scratch.numel(),
            lists=lists.data_ptr(), list_bytes=lists.numel(), first=pair_splats[0].data_ptr(),
            second=pair_splats[1].data_ptr(), room=room, splat_room=splat_room, radii=radii.data_ptr(),
            drawn=_at(drawn), image=_at(None if as_bytes else image), levels=_at(image if as_bytes else None),
            alpha=_at(alpha), median=_at(median), maps=_at(maps),
        )  # fmt: skip
        seconds += found.project_seconds
        if found.pairs > most:
            raise RuntimeError(
                f"sw_rasterizers: {found.pairs} splat-tile pairs are more than {most}: draw fewer Gaussians or a "
                f"smaller image, or set {LIMIT} (12 to 20 bytes each)"
            )
        _Recent.splats = max(found.used, _Recent.splats - _Recent.splats // 1024)
        _Recent.pairs = max(found.pairs, _Recent.pairs - _Recent.pairs // 1024)
        if found.complete:
            break
        splat_room, room = min(count, _rounded(found.used)), min(most, _rounded(found.pairs))
    call.counts = [found.seen, found.pairs, found.evaluated, found.blended, found.invalid]
    if flags & COUNT:
        stages = seconds, found.sort_seconds, found.bin_seconds, found.blend_seconds
        call.seconds.update(zip(FORWARD_STAGES, stages, strict=True))
    if drawn is None:
        return Drawn(image, radii, alpha, median, maps, None)
    counts = {"splat_room": splat_room, "used": found.used, "pairs": found.pairs}
    return Drawn(image, radii, alpha, median, maps, Kept(lists, pair_splats[found.kept_in], drawn, counts))


def row_length(picture: Picture, device: int, *, maps: bool = False) -> int:
    """Return how many sums `blend_backward` makes of a Gaussian on a GPU."""
    return _row_length(device, picture.channels, picture.colors, picture.flags, maps)


def blend_backward(picture: Picture, count: int, kept: Kept, by: Tensors, again: Again | None = None) -> Tensor:
    """Return sums [N, row_length] of N Gaussians from the gradients of a picture.

    by      gradients of "image", and of "alpha", "median", "maps" or None; contiguous
    """
    image = by["image"]
    maps = by.get("maps") is not None
    device = image.get_device()
    scratch = None
    if picture.flags & ORDERED:
        sizes = plan_sums(picture, count, kept, device, maps=maps, median=by.get("median") is not None)
        scratch = image.new_empty(sizes.blend_bytes, dtype=torch.uint8)
    length = row_length(picture, device, maps=maps)
    rows = image.new_empty(count, length)

    def fixed() -> dict[str, Any]:
        more = {"feature_channels": picture.channels - picture.colors - picture.depths, "device": device}
        unwanted = {"sh_degree", "scale_modifier", "eps2d"}
        return {**{name: x for name, x in picture.settings().items() if name not in unwanted}, **more}

    found = (_once(cuda_face.blend_backward) if again is None else again["blend_backward"])(
        fixed, **{f"by_{name}": x for name, x in by.items()}, camera=tuple(picture.call.camera),
        lists=kept.lists.data_ptr(), list_bytes=kept.lists.numel(), pair_splats=kept.pair_splats.data_ptr(),
        room=kept.pair_splats.numel(), **kept.sizes, scratch=_at(scratch),
        scratch_bytes=0 if scratch is None else scratch.numel(), rows=rows.data_ptr(), count=count, row_length=length,
    )  # fmt: skip
    if picture.flags & COUNT:
        picture.call.seconds[BACKWARD_STAGES[0]] = found.blend_seconds
    return rows


def project_backward(
    picture: Picture, tensors: Tensors, drawn: Tensor, rows: Tensor, wanted: Collection[str],
    updates: dict[str, AdamUpdate] | None = None, *, maps: bool = False, again: Again | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Return the gradients that are wanted, by name of the input, or "grad2d" and "absgrad2d" [N,2].

    rows        of `blend_backward`
    updates     of sh_dc, sh_rest: where they are wanted, the update is done instead, and there is no gradient
    maps        whether rows hold sums of maps
    """
    call, means = picture.call, tensors["means"]
    # Only of the tensors that were drawn, not of copies of them.
    offered = {name: u for name, u in (updates or {}).items() if name in wanted}
    done = {name: u for name, u in offered.items() if tensors[name].data_ptr() == u.param.data_ptr()}
    wanted = set(wanted) - set(done)
    # Rows of shared shapes are summed up.
    shared = {"scales", "quats"} if call.geom_indices is not None else set()
    made: Tensors = {
        name: torch.zeros_like(x) if name in shared else torch.empty_like(x)
        for name, x in tensors.items()
        if name in wanted and x is not None
    }
    made |= {name: means.new_empty(means.shape[0], 2) for name in ("grad2d", "absgrad2d") if name in wanted}

    def fixed() -> dict[str, Any]:
        more = {"geom_indices": call.geom_indices, "visible": call.visible, "color_channels": picture.colors}
        unwanted = {"channels", "background", "backdrop"}
        settings = {name: x for name, x in picture.settings().items() if name not in unwanted}
        return {**settings, **more}

    found = (_once(cuda_face.project_backward) if again is None else again["project_backward"])(
        fixed, tuple(done), **_rows(means.shape[0], again), **{name: x for name, x in tensors.items() if x is not None},
        camera=tuple(call.camera), drawn=drawn, rows=rows, maps=maps,
        **_adam("dc", done.get("sh_dc")), **_adam("rest", done.get("sh_rest")),
        **{f"of_{name}": x.data_ptr() for name, x in made.items()},
    )  # fmt: skip
    # Whoever offered an update sees by the version that it is done: of what was drawn, since the update may name an
    # alias that counts on its own, as `param.data` does.
    torch.autograd.graph.increment_version([x for name in done if (x := tensors[name]) is not None])
    if picture.flags & COUNT:
        call.seconds[BACKWARD_STAGES[1]] = found.project_seconds
    return made


def plan_sums(
    picture: Picture, count: int, kept: Kept, device: int, *, maps: bool = False, median: bool = False
) -> cuda_face.plan_sums_call:
    """Return how much memory sums over the pairs of a drawing need."""
    height, width = picture.size
    return cuda_face.plan_sums(
        channels=picture.channels, color_channels=picture.colors, flags=picture.flags, maps=maps,
        used=kept.sizes["used"], pairs=kept.sizes["pairs"], pixels=height * width if median else 0, count=count,
        device=device,
    )  # fmt: skip


def visible_radii(call: Call, geometry: Tensors) -> Tensor:
    """Return radii [N] int32, px, from means, scales, quats, cov3d and scale_factors; 0 = culled."""
    check()
    means = geometry["means"]
    radii = means.new_empty(len(means), dtype=torch.int32)
    cuda_face.visible_radii(
        **geometry, geom_indices=call.geom_indices, visible=call.visible, radii=radii, camera=call.camera,
        width=call.width, height=call.height, flags=int(call.flags), scale_modifier=call.scale_modifier,
        eps2d=call.eps2d,
    )  # fmt: skip
    return radii


def _once(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation as something that is called as `Repeated` is."""
    return lambda fixed, form=None, /, **changed: operation(**fixed(), **changed)


def _rows(count: int, again: Again | None) -> dict[str, int]:
    """Return the counts of Gaussians and shapes, which may change where calls are else alike."""
    return {"count": count} if again is None else {"count": count, "shapes": count}


def _at(tensor: Tensor | None) -> int | None:
    """Return the address of memory that was made to fit."""
    return None if tensor is None else tensor.data_ptr()


def _adam(name: str, u: AdamUpdate | None) -> dict[str, Any]:
    """Moments and rates of an update, as project_backward names them."""
    if u is None:
        return {f"{name}_rates": (0.0,) * 6}
    rates = u.lr / (1 - u.beta1**u.step), 1 - u.beta1, u.beta2, 1 - u.beta2, (1 - u.beta2**u.step) ** -0.5, u.eps
    return {f"{name}_exp_avg": u.exp_avg, f"{name}_exp_avg_sq": u.exp_avg_sq, f"{name}_rates": rates}


def _rounded(count: int) -> int:
    """An eighth more, to a number that many counts share, so that memory and plans are used again."""
    step = max(1024, 1 << max(0, count.bit_length() - 4))
    return -(-(count + count // 8) // step) * step


@functools.lru_cache(maxsize=64)
def _plan(
    device: int, count: int, splat_room: int, room: int, height: int, width: int, channels: int, colors: int, flags: int
) -> cuda_face.plan_render_call:
    return cuda_face.plan_render(
        count=count, splat_room=splat_room, room=room, width=width, height=height, channels=channels,
        color_channels=colors, flags=flags, device=device,
    )  # fmt: skip


@functools.lru_cache(maxsize=64)
def _row_length(device: int, channels: int, colors: int, flags: int, maps: bool) -> int:
    return cuda_face.plan_sums(
        channels=channels, color_channels=colors, flags=flags, maps=maps, used=0, pairs=0, pixels=0, count=0,
        device=device,
    ).row_length  # fmt: skip
