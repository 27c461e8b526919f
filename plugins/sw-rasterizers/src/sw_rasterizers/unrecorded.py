"""Drawing unknown to autograd: the gradients are asked for, and drawings that are alike are checked once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from splatwizard_core.api import Camera, ConfigError, GaussianInputs, RasterizerInfo, RasterOptions
from splatwizard_native import Repeated
from sw_rasterizers import cpu, cuda, cuda_face
from sw_rasterizers.call import INPUTS, Call, Flag, camera_numbers
from sw_rasterizers.ops import gradients_on_cuda, updates_of

Drawing = tuple[Tensor, Tensor, "Tensor | None", "Tensor | None", "Tensor | None"]
"""Image, radii, and where they were asked for alpha, median depth, maps of surfels."""


class Gradients(Protocol):
    """Gives, once, gradients by names of INPUTS from those of the image, and maybe of alpha and the maps of surfels."""

    def __call__(
        self, by_image: Tensor, by_alpha: Tensor | None = None, by_maps: Tensor | None = None
    ) -> dict[str, Tensor]: ...


class _Last(NamedTuple):
    form: tuple[Any, ...]
    call: Call
    again: cuda.Again


class _Kept(threading.local):
    """The last drawing of a thread, whose structs are its own."""

    def __init__(self) -> None:
        self.drawn: _Last | None = None


class Unrecorded:
    """Draws for one rasterizer; remembers its last drawing on a GPU, since the next one may be like it."""

    def __init__(self, info: RasterizerInfo) -> None:
        self._info = info
        self._kept, self._radii = _Kept(), Repeated(cuda_face, "visible_radii")

    def draw(
        self,
        g: GaussianInputs,
        cam: Camera,
        opt: RasterOptions,
        tensors: dict[str, Tensor | None],
        call_of: Callable[[], Call],
    ) -> tuple[Call, Drawing, Gradients]:
        """Draw one view: its call, what was drawn, and what gives the gradients of all inputs.

        They fill the statistics of the call. An input with an offered update (`splatwizard_native.offer_update`) that
        is done then has none.

        tensors     `g` by names of INPUTS
        call_of     makes the call, and checks it

        Raises what `check_request` and `call_of` raise; ConfigError for scores.
        """
        form, last = _form(g, cam, opt), self._kept.drawn
        if form is not None and last is not None and last.form == form:
            call, again = last.call.repeated(camera_numbers(cam)), last.again
        else:
            self._info.check_request(g, opt)
            if opt.scores or opt.fisher:
                raise ConfigError("scores are no part of a drawing to be learned from: ask `accumulate` for them")
            call, again = call_of(), cuda.again()
            self._kept.drawn = None if form is None else _Last(form, call, again)
        return call, *_draw(call, tensors, None if form is None else again)

    def radii(self, g: GaussianInputs, cam: Camera) -> Tensor | None:
        """Return radii [N] int32, px, of ellipsoids on a GPU; None on the CPU, and for what few trainings have.

        Raises what `check_geometry` raises.
        """
        rare = g.cov3d, g.geom_indices, g.scale_factors, g.visible
        if not g.means.is_cuda or any(x is not None for x in rare):
            return None
        rows = g.means.shape[0]
        means, scales, quats = (None if x is None else x.contiguous() for x in (g.means, g.scales, g.quats))
        form = [_kind(x, rows) for x in (means, scales, quats)]
        radii = g.means.new_empty(rows, dtype=torch.int32)

        def checked() -> dict[str, Any]:
            self._info.check_geometry(g)
            cuda.check()
            return {"scale_modifier": 1.0, "eps2d": RasterOptions.eps2d, "flags": 0}

        self._radii(
            checked, form, means=means, scales=scales, quats=quats, radii=radii, count=rows, shapes=rows,
            camera=tuple(camera_numbers(cam)), width=cam.width, height=cam.height,
        )  # fmt: skip
        return radii


def _form(g: GaussianInputs, cam: Camera, opt: RasterOptions) -> tuple[Any, ...] | None:
    """Return what checks of a drawing look at; None on the CPU, and for inputs that few trainings have."""
    sh, rows = g.sh, g.means.shape[0]
    rare = g.cov3d, g.geom_indices, g.scale_factors, g.features, g.visible
    if not g.means.is_cuda or any(x is not None for x in rare):
        return None
    if sh is not None and (sh.dense is not None or sh.codebook is not None):
        return None
    colors = (g.colors,) if sh is None else (sh.dc, sh.rest)
    forms = [_kind(x, rows) for x in (g.means, g.opacities, g.scales, g.quats, *colors)]
    degree = -1 if sh is None else sh.active_degree
    return *forms, degree, opt, cam.width, cam.height, torch.are_deterministic_algorithms_enabled()


def _kind(x: Tensor | None, rows: int) -> tuple[Any, ...] | None:
    """Return what checks of a tensor look at, where its rows may be any number, the same for all."""
    return None if x is None else (x.shape[0] == rows, x.shape[1:], x.dtype, x.get_device(), x.is_contiguous())


def _draw(call: Call, tensors: dict[str, Tensor | None], again: cuda.Again | None) -> tuple[Drawing, Gradients]:
    """Draw, and return what gives gradients; `again` of drawings on a GPU that are like this one."""
    call.flags |= Flag.SAVE
    named = {name: None if (x := tensors.get(name)) is None else x.contiguous() for name in INPUTS}
    means = named["means"]
    assert means is not None
    picture = cpu.Picture(call, named, int(call.flags))
    updates = updates_of(tensors) if means.is_cuda and not picture.flags & Flag.SURFELS else {}
    drawn: Any = cuda.draw(picture, named, again) if means.is_cuda else cpu.draw(picture, named)
    kept = [drawn.kept]  # gone before there is room for the gradients of the inputs
    wanted = {name for name, x in named.items() if x is not None}
    buffers = {"grad2d": call.grad2d, "absgrad2d": call.absgrad2d}
    statistics = {name: buffer for name, buffer in buffers.items() if buffer is not None}

    def gradients(by_image: Tensor, by_alpha: Tensor | None = None, by_maps: Tensor | None = None) -> dict[str, Tensor]:
        given = {"image": by_image, "alpha": by_alpha, "median": None, "maps": by_maps}
        by = {name: None if x is None else x.contiguous() for name, x in given.items()}
        if means.is_cuda:
            return gradients_on_cuda(picture, named, kept, by, wanted, updates, again)
        found = cpu.draw_backward(picture, named, kept.pop(), by, wanted | statistics.keys())
        for name, buffer in statistics.items():
            buffer.set(found[name])
        return found

    return drawn[:5], gradients
