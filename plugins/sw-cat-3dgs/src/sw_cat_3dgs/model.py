"""The model of CAT-3DGS: anchors with masks weighted by how often an anchor is seen, and their context model."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Any, Literal

import torch
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.rate_model import RateInputs
from torch import Tensor

from splatwizard_core.api import Camera, Rasterizer
from sw_cat_3dgs.context import STEP_OFFSET, CatContext, plane_bits
from sw_cat_3dgs.fast import plane_graphs, plane_sites
from sw_cat_3dgs.rate_model import CatRateModel

VIEWS_AT_ONCE = 16
"""Views whose radii are counted together, 64 bytes an anchor: each operator is launched once for all of them."""

Trained = Literal["everything", "spatial models", "all but planes", "nothing"]


class CatAnchors(CodedAnchors):
    """CodedAnchors whose context is a CatContext.

    view_weights    [N] buffer: views that see an anchor over their mean, times `view_factor`; multiplies its masks
    views_stale     anchors came or went since the views were counted
    context         predicts attributes
    trained         parameters that get gradients, see `train_only`
    """

    ROWS = (*CodedAnchors.ROWS, "view_weights")

    view_weights: Tensor

    STEP_POWERS = (0.0, 1.0, 1.0)

    def __init__(self, *tensors: Tensor, context: CatContext, view_factor: float = 1.0, **kwargs: Any) -> None:
        """Tensors and other arguments as of CodedAnchors."""
        super().__init__(*tensors, base_steps=context.shape.base_steps, **kwargs)
        self.context = context.to(self.anchors.device)
        self.view_factor = view_factor
        self.views_stale = True
        self.trained: Trained = "everything"
        self.register_buffer("view_weights", self.anchors.new_ones(len(self.anchors)))
        self._places: tuple[tuple[Any, ...], Tensor] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy works out anew where its anchors lie."""
        return {**self.__dict__, "_places": None}

    def noise_steps(self, like: Tensor) -> Tensor:
        """Return the base steps times the factor of a predicted step whose logit is 0."""
        return super().noise_steps(like) * STEP_OFFSET

    def mask_weights(self) -> Tensor:
        return self.view_weights[:, None]

    @torch.no_grad()
    def count_views(self, cameras: Iterable[Camera], rasterizer: Rasterizer) -> None:
        """Weigh each anchor by how many of the cameras see it; what none sees is dropped."""
        seen, balls, left = torch.zeros_like(self.view_weights), self.balls(), iter(cameras)
        while some := list(islice(left, VIEWS_AT_ONCE)):
            radii = [rasterizer.visible_filter(balls, camera.to(self.device)) for camera in some]
            seen += (torch.stack(radii) > 0).sum(dim=0)
        self.view_weights = self.view_factor * seen / seen.mean().clamp(min=1e-12)
        self.views_stale = False

    def places(self) -> Tensor:
        """[N,3] integer places of the anchors in the triplane, kept until anchors or frame are others."""
        codes, frame = self.codes(), self.context.frame
        key = (codes, frame, frame._version)
        kept = self._places
        if kept is None or kept[0][0] is not codes or kept[0][1] is not frame or kept[0][2] != key[2]:
            kept = self._places = (key, self.context.places(codes, self.bounds))
        return kept[1]

    def context_rows(self) -> RateInputs:
        """The places of the anchors in the triplane; their sites on the planes, where `fast` takes these."""
        triplane, places = self.context.triplane, self.places()
        return plane_sites.kept_sites(triplane, places) if plane_sites.fits(triplane) else (places,)

    @property
    def rate_model(self) -> CatRateModel:
        return CatRateModel(self.context, self.base_steps_like(self.features), self.floors)

    def plane_bits(self, share: float) -> Tensor:
        """Estimate the bits of the planes from a share of their channels; differentiable."""
        estimate = plane_graphs.plane_bits if plane_graphs.fits(self.context) else plane_bits
        return estimate(self.context, share, self.own_generator())

    def train_only(self, trained: Trained) -> None:
        """Give gradients to these parameters alone."""
        self.trained = trained
        self.requires_grad_(trained in ("everything", "all but planes"))
        if trained == "all but planes":
            self.context.triplane.requires_grad_(False)
        if trained == "spatial models":
            self.context.arms.requires_grad_(True)

    def state_dict_extra(self) -> dict[str, Any]:
        return {
            **super().state_dict_extra(),
            "views_stale": self.views_stale,
            "trained": self.trained,
            "rounded": self.context.rounded,
        }

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self.views_stale = bool(extra["views_stale"])
        self.context.rounded = bool(extra["rounded"])
        self.train_only(extra["trained"])
