"""The model while it trains: splats as the 22 numbers that the file holds, drawn as what rounding leaves of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from splatwizard_core.api import SH, GaussianInputs, GaussianModel, SplatModel
from sw_codecs.positions import morton
from sw_wisp.appearance import AppearanceNetwork
from sw_wisp.cube import Cube
from sw_wisp.fast import replay
from sw_wisp.fast.kernels import fit_kernels
from sw_wisp.fast.splats import drawable as fast_drawable
from sw_wisp.file import Scene
from sw_wisp.layers import Known, Layers, as_known, coarsened
from sw_wisp.numbers import GROUPS, LATENTS, NUMBERS, SIZE
from sw_wisp.octree import Cells, position_bits
from sw_wisp.plain import bounds_in, plain_gaussians
from sw_wisp.pyramid import FEATURES
from sw_wisp.rate import Forecast
from sw_wisp.rate_model import Placed, PyramidRate, StaticRate, bits_of
from sw_wisp.rounding import AS_THEY_ARE, FINAL, FLOAT, HARD, Rounding
from sw_wisp.shape import bounded
from sw_wisp.splats import Draws, Shown, drawable

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer


class WispModel(SplatModel):
    """N splats.

    means       [N,3] world units
    opacity     [N] logit
    shape       [N,5] deviator of the log covariance
    size        [N] mean log scale, world units; the file has it relative to the edge of the splat's cell
    colour      [N,3] luma and chroma
    latents     [N,12] view dependence
    levels      [N] int64, level of the octree
    subsets     [N] int64, which subset of the file it belongs to
    features, view_features
                [N,69] what networks of the rate model see of the splats before; only where it has networks
    prefix_features
                [N,K,69] the same for latents that prefixes lack, see `pyramid.prefix_slots`; K is 0 without layers
    network     latents and colour to SH bands 1 and up
    rate        distributions of the 22 numbers
    cube        the root cube of the octree

    phase       what is drawn: see `rounding`; in eval mode noise and soft rounding are left out
    sharpness   of soft rounding, up to `sharpest`
    jitters     whether positions are drawn anywhere in a cell of the splat's level around them
    adapts      whether quantiser steps may follow the rate model
    counted     share of all splats whose bits are counted at each step
    layers      packets of the file
    packets     how many of them are drawn in training; None: all
    """

    ROWS = ("means", "opacity", "shape", "size", "colour", "latents", "levels", "subsets")
    NUMBERS = ("opacity", "shape", "size", "colour", "latents")
    """The parameters that hold the 22 numbers, in their order."""

    levels: Tensor
    subsets: Tensor
    features: Tensor
    view_features: Tensor
    prefix_features: Tensor

    def __init__(
        self, means: Tensor, opacity: Tensor, shape: Tensor, size: Tensor, colour: Tensor, latents: Tensor,
        levels: Tensor, *, cube: Cube, network: AppearanceNetwork, rate: StaticRate | PyramidRate,
        sharpest: float = 8.0,
    ) -> None:  # fmt: skip
        super().__init__()
        rows = {
            "means": means, "opacity": opacity, "shape": shape, "size": size, "colour": colour, "latents": latents
        }  # fmt: skip
        for name, values in rows.items():
            self.register_parameter(name, nn.Parameter(values.detach().float().contiguous()))
        self.register_buffer("levels", levels)
        self.register_buffer("subsets", torch.zeros_like(levels))
        for name in rate.CONTEXT:
            if name not in self.ROWS:
                self.register_buffer(name, means.new_zeros(len(means), FEATURES))
                self.ROWS = (*self.ROWS, name)
        if isinstance(rate, PyramidRate):
            self.register_buffer(rate.OF_PREFIXES, means.new_zeros(len(means), 0, FEATURES))
            self.ROWS = (*self.ROWS, rate.OF_PREFIXES)
        self.network, self.rate = network, rate
        self.cube = cube
        self.phase, self.sharpness, self.sharpest, self.jitters, self.adapts = FLOAT, 1.0, sharpest, False, False
        self.split_seed, self.counted = 0, 0.0
        self.layers, self.packets = Layers(), None

    def log_edges(self, levels: Tensor) -> Tensor:
        """Logarithms [N] of the edges of cells at levels [N]."""
        return math.log(self.cube.edge) - math.log(2.0) * levels.float()

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the log scales."""
        return bounds_in(self.cube)

    def numbers(self) -> Tensor:
        """The 22 numbers [N,22] of all splats, size relative to the cell; differentiable."""
        size = self.size - self.log_edges(self.levels)
        return torch.cat([self.opacity[:, None], self.shape, size[:, None], self.colour, self.latents], dim=1)

    @torch.no_grad()
    def set_numbers(self, values: Tensor) -> None:
        """Take the 22 numbers [N,22] of all splats, size relative to the cell, in place."""
        opacity, shape, size, colour, latents = (values[:, group.columns] for group in GROUPS)
        self.opacity.copy_(opacity.squeeze(1))
        self.shape.copy_(shape)
        self.size.copy_(size.squeeze(1) + self.log_edges(self.levels))
        self.colour.copy_(colour)
        self.latents.copy_(latents)

    def predicted(self) -> tuple[Forecast, Tensor]:
        """Distributions of the numbers of all splats, and these [N,22] as this phase rounds them; differentiable."""
        return self.rate.predict(self._context, self.numbers(), self.rounding)

    @property
    def _context(self) -> tuple[Tensor, ...]:
        return tuple(getattr(self, name) for name in self.rate.CONTEXT)

    def _without_latents(self, forecast: Forecast, drawn: Tensor, known: Known, seen: Tensor | None) -> Forecast:
        """The same forecast, but for latents that are missing: predicted from what a decoder knows instead of them.

        known   of each splat; seen [N,69] its features for latents, None: those of the prefix that `known` is of
        """
        if not isinstance(self.rate, PyramidRate) or (seen is None and not self.prefix_features.shape[1]):
            return forecast
        if seen is None:
            at = (known.slot - 1).clamp_min(0)[:, None, None].expand(-1, -1, FEATURES)
            seen = self.prefix_features.gather(1, at).squeeze(1)
        latents = self.rate.networks.latents(seen, coarsened(drawn, forecast, known))
        return forecast._replace(mean=torch.cat([forecast.mean[:, : LATENTS.columns.start], latents], dim=1))

    @property
    def rounding(self) -> Rounding:
        """Stand-in for rounding."""
        rounds = self.phase == HARD or (self.training and self.phase not in (FLOAT, FINAL))
        return Rounding(self.phase, self.sharpness, self.sharpest) if rounds else AS_THEY_ARE

    def bits(self) -> Tensor:
        """Bits [N,22] of the numbers of all splats as this phase rounds them; differentiable."""
        forecast, drawn = self.predicted()
        return bits_of(drawn, forecast)

    def drawn_and_bits(self, draws: Draws) -> tuple[Tensor, Tensor | None]:
        """Numbers [N,22] of all splats as drawn, and bits of a splat, in the mean of a sample; differentiable."""
        numbers, sample, known = self.numbers(), draws.sample, draws.known
        first = 0 if self.rounding is AS_THEY_ARE and known is None else len(numbers)
        if not first and sample is None:
            return numbers, None

        def behind(rows: Tensor) -> Tensor:
            return rows if sample is None else torch.cat([rows[:first], rows.index_select(0, sample)])

        # The sample stands behind all splats, under noise of its own, so that networks run once.
        context = tuple(behind(each) for each in self._context)
        rounding = replace(self.rounding, drawn_noise=draws.noise, soft=draws.soft)
        forecast, drawn = self.rate.predict(context, behind(numbers), rounding)
        if sample is None:
            if known is not None:
                known = known.of(self.subsets)
                drawn = as_known(drawn, self._without_latents(forecast, drawn, known, None), known)
            return drawn, None
        bits = bits_of(drawn, forecast, len(sample)).sum() / len(sample)
        return drawn[:first] if first else numbers, bits

    def begin_rate(self) -> None:
        """Start the rate model anew from the splats."""
        self._take(self.rate.begin(self._placed()))

    def fit_rate(self, updates: int, weights: Tensor | None) -> None:
        """Let the rate model learn from the splats as they are drawn, without pictures.

        weights     [N,22] bits that a squared unit of error of each number is worth, for the steps; None: they stay
        """
        self.rate.fit(self._context, self.numbers().detach(), self.rounding, updates, weights)

    def adapt(self) -> None:
        """Let quantiser steps follow the rate model from here on."""
        self.adapts = True
        self.rate.adapt()

    def measure(self) -> None:
        """Bring the rate model up to date with the splats; once the integers are fixed, only what it reads."""
        self._take(self.rate.measure(self._placed(), self._context, fixed=self.phase == FINAL))

    def _placed(self) -> Placed:
        cells = self.cube.cells(self.means, self.levels)
        order, planes = self.layers.order, self.layers.planes
        return Placed(self.numbers().detach(), self.levels, cells, self.subsets, order, planes, bool(order))

    def _take(self, rows: Mapping[str, Tensor]) -> None:
        for name, values in rows.items():
            if getattr(self, name).shape == values.shape:
                getattr(self, name).copy_(values)  # a step that is replayed reads them where they stand
            else:  # another order of packets
                setattr(self, name, values)

    @torch.no_grad()
    def place_bits(self) -> Tensor:
        """Bits [N] float64 of each splat's place in the octree, by coding them; bits that several need are shared."""
        levels, cells = self.cube.settled(self.means, self.levels, self.opacity)
        codes = morton.encode(cells.cpu().numpy())
        return torch.from_numpy(position_bits(Cells(levels.cpu().numpy(), codes))).to(self.device)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All splats, whatever the camera; in training `extras["bits"]` are those of one, in the mean of a sample."""
        shown = replay.shown(self) if replay.fits(self) else None
        return self._inputs(self.shown(self.draws()) if shown is None else shown)

    def draws(self) -> Draws:
        """Draw what a step needs."""
        n = self.num_rows
        count = max(1, math.ceil(self.counted * n)) if self.training and self.counted else 0
        sample = torch.randint(n, (count,), device=self.device) if count else None
        noise = self.rounding.noise(self.means.new_empty(n + count, NUMBERS))
        places = torch.rand_like(self.means) if self.jitters and self.training else None
        if not self.training or self.packets is None:
            return Draws(sample, noise, places)
        return Draws(sample, noise, places, Known.after(self.layers.order[: self.packets], self.layers, self.device))

    def shown(self, draws: Draws) -> Shown:
        """Return what a rasterizer draws, and the bits of a splat, in tensors whose sizes no value decides."""
        visible = None if draws.known is None else draws.known.there[self.subsets]
        return self._shown(*self.drawn_and_bits(draws), draws.places)._replace(visible=visible)

    @torch.no_grad()
    def forecast_with(self, packets: Sequence[tuple[int, str]], forecast: Forecast, drawn: Tensor) -> Forecast:
        """The same, where latents are predicted from what these packets tell alone: a decoder has no others."""
        if not isinstance(self.rate, PyramidRate):
            return forecast
        told = replace(self._placed(), order=tuple(packets), prefixes=False)
        walked = self.rate.measure(told, self._context, fixed=self.phase == FINAL)
        known = Known.after(packets, self.layers, self.device).of(self.subsets)
        return self._without_latents(forecast, drawn, known, walked["view_features"])

    def prefix_of(
        self, packets: Sequence[tuple[int, str]], forecast: Forecast, drawn: Tensor, swell: Tensor | None = None
    ) -> GaussianInputs:
        """Splats as some packets alone tell of them, of what `predicted` returned; those of other subsets invisible.

        swell       [J,2] what is added to size and opacity of each subset; None: what the layers say
        """
        known = Known.after(packets, self.layers, self.device)
        if swell is not None:
            known = known._replace(swell=swell)
        known = known.of(self.subsets)
        return self._inputs(self._shown(as_known(drawn, forecast, known), None, None)._replace(visible=known.there))

    def _shown(self, values: Tensor, bits: Tensor | None, places: Tensor | None) -> Shown:
        edges = self.log_edges(self.levels)
        means = None if places is None else self.means + (places - 0.5) * edges.exp()[:, None]
        make = fast_drawable if fit_kernels(values, edges) else drawable
        return make(values, edges, self.bounds, self.network)._replace(means=means, bits=bits)

    def _inputs(self, shown: Shown) -> GaussianInputs:
        return GaussianInputs(
            means=self.means if shown.means is None else shown.means, opacities=shown.opacities,
            cov3d=shown.covariances, sh=SH(dc=shown.dc, rest=shown.rest, active_degree=self.network.degree),
            extras={} if shown.bits is None else {"bits": shown.bits}, visible=shown.visible,
        )  # fmt: skip

    @torch.no_grad()
    def tidied(self) -> dict[str, Tensor]:
        """The 22 numbers by parameter, within the ranges that are kept; shapes within the bounds of the root cube."""
        shape, size = bounded(self.shape, self.size, *self.bounds)
        edges = self.log_edges(self.levels)
        limits = {group.name: group.limit for group in GROUPS}
        size = (size - edges).clamp(-limits["size"], limits["size"]) + edges
        found = {"opacity": self.opacity, "shape": shape, "size": size, "colour": self.colour, "latents": self.latents}
        return {k: v if k == "size" else v.detach().clamp(-limits[k], limits[k]) for k, v in found.items()}

    @torch.no_grad()
    def as_gaussians(self) -> GaussianModel:
        """The plain Gaussians that are drawn in eval mode, with all SH bands."""
        drawn = self.numbers() if self.rounding is AS_THEY_ARE else self.predicted()[1]
        return plain_gaussians(self.means, drawn, self.log_edges(self.levels), self.cube, self.network)

    @torch.no_grad()
    def coded(self) -> Scene:
        """Contents of the file: of a trained model the integers that the training has fixed."""
        levels, cells = self.cube.settled(self.means, self.levels, self.opacity)
        values = self.numbers()
        values[:, SIZE.columns] += (self.log_edges(self.levels) - self.log_edges(levels))[:, None]
        return Scene(
            self.cube, levels, cells, values, self.network.layers(), sh_degree=self.network.degree,
            base_steps=tuple(self.rate.base_steps.tolist()), context=self.rate.exact(), in_order=self.phase == FINAL,
            subsets=self.subsets, order=self.layers.order or None, planes=self.layers.planes,
            psnr=self.layers.psnr or None, swell=self.layers.swell,
        )  # fmt: skip

    def state_dict_extra(self) -> dict[str, Any]:
        modes = {"phase": self.phase, "sharpness": self.sharpness, "jitters": self.jitters}
        modes |= {"rounds": self.network.rounds, "adapts": self.adapts}
        modes |= {"order": [list(each) for each in self.layers.order], "planes": self.layers.planes}
        modes |= {"psnr": list(self.layers.psnr), "swell": [list(row) for row in self.layers.swell]}
        return {**modes, "seed": self.split_seed, "low": list(self.cube.low), "edge": self.cube.edge}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        self.phase, self.sharpness = str(extra["phase"]), float(extra["sharpness"])
        self.jitters, self.split_seed = bool(extra["jitters"]), int(extra["seed"])
        self.network.rounds = bool(extra["rounds"])
        if self.network.rounds:
            self.rate.round_weights()
        if extra["adapts"]:
            self.adapt()
        order = tuple((int(subset), str(kind)) for subset, kind in extra["order"])
        swell = tuple(tuple(int(x) for x in row) for row in extra["swell"])
        self.layers = Layers(order, int(extra["planes"]), tuple(float(x) for x in extra["psnr"]), swell)
        low = [float(x) for x in extra["low"]]
        self.cube = Cube((low[0], low[1], low[2]), float(extra["edge"]))
