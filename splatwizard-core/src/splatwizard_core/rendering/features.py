"""Capabilities of rasterizers, and which of them a request needs."""

from __future__ import annotations

import enum
import functools
import operator
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from splatwizard_core.gaussians.inputs import GaussianInputs
    from splatwizard_core.rendering.rasterizer import RasterOptions


class Feature(enum.Flag):
    """Capabilities of a rasterizer; registry entries spell them as strings of the same names."""

    BACKWARD = enum.auto()
    ANTIALIAS = enum.auto()
    ABSGRAD = enum.auto()
    VISIBLE_FILTER = enum.auto()
    COV3D = enum.auto()
    COLORS_ND = enum.auto()
    EXTRA_FEATURES = enum.auto()
    SPLIT_SH = enum.auto()
    INDEXED_SH = enum.auto()
    INDEXED_GEOM = enum.auto()
    NO_COLOR_CLAMP = enum.auto()
    DEPTH_INVERSE = enum.auto()
    DEPTH_ACCUM = enum.auto()
    DEPTH_EXPECTED = enum.auto()
    DEPTH_MEDIAN = enum.auto()
    ALPHA_MAP = enum.auto()
    NORMALS = enum.auto()
    DISTORTION = enum.auto()
    SURFEL = enum.auto()
    SCORE_HITS = enum.auto()
    SCORE_OPACITY = enum.auto()
    SCORE_OPACITY_T = enum.auto()
    SCORE_BLEND = enum.auto()
    SCORE_BLEND_SQ = enum.auto()
    SCORE_BLEND_MAX = enum.auto()
    SCORE_SHOWN = enum.auto()
    SCORE_GAMMA = enum.auto()
    SCORE_DIST = enum.auto()
    SCORE_PIXEL_WEIGHT = enum.auto()
    SCORE_GRAD_SQ = enum.auto()
    SCORE_REMOVAL = enum.auto()
    FISHER = enum.auto()
    TIGHT_TILES = enum.auto()
    FLOAT64 = enum.auto()
    DETERMINISTIC = enum.auto()
    FRAGMENT_GRAD = enum.auto()
    UINT8_OUT = enum.auto()

    @property
    def names(self) -> frozenset[str]:
        """{"BACKWARD", ...}: as registry entries spell them."""
        return _names(self)

    @classmethod
    def asked_by(cls, opt: RasterOptions, g: GaussianInputs | None = None) -> Feature:
        """The features that drawing `g` with `opt` needs; without `g`, those that the options alone ask for.

        Raises ValueError for an option value that no rasterizer knows.
        """
        asked: Feature | None = vars(opt).get("_asked")  # options do not change, and every step of a training asks
        if asked is None:
            asked = vars(opt)["_asked"] = _of_options(opt)
        if g is None:
            return asked
        return _all_of(
            asked,
            cls.geometry_of(g),
            cls.BACKWARD if g.requires_grad() else None,
            cls.DETERMINISTIC if torch.are_deterministic_algorithms_enabled() else None,
            cls.EXTRA_FEATURES if g.features is not None else None,
            cls.COLORS_ND if g.colors is not None and g.colors.shape[-1] != 3 else None,
            cls.INDEXED_SH if g.sh is not None and g.sh.codebook is not None else None,
            cls.SPLIT_SH if g.sh is not None and g.sh.dc is not None else None,
        )

    @classmethod
    def geometry_of(cls, g: GaussianInputs) -> Feature:
        """The features that reading the shapes of `g` needs, whatever is drawn."""
        return _all_of(
            cls.COV3D if g.cov3d is not None else None,
            cls.INDEXED_GEOM if g.geom_indices is not None or g.scale_factors is not None else None,
            cls.SURFEL if g.scales is not None and g.scales.shape[-1] == 2 else None,
            cls.FLOAT64 if g.means.dtype == torch.float64 else None,
        )


_DEPTHS = {
    "inverse": Feature.DEPTH_INVERSE, "accumulated": Feature.DEPTH_ACCUM, "expected": Feature.DEPTH_EXPECTED,
    "median": Feature.DEPTH_MEDIAN,
}  # fmt: skip
_SCORES = {kind: Feature[f"SCORE_{kind.upper()}"] for kind in (
    "hits", "opacity", "opacity_T", "blend", "blend_sq", "blend_max", "shown", "gamma", "dist", "grad_sq", "removal",
)}  # fmt: skip


@functools.cache
def _names(features: Feature) -> frozenset[str]:
    return frozenset(f.name for f in Feature if f in features and f.name is not None)


@functools.cache  # a training asks for the same at every step, and `|` of flags is slow
def _all_of(*features: Feature | None) -> Feature:
    return functools.reduce(operator.or_, filter(None, features), Feature(0))


def _of_options(opt: RasterOptions) -> Feature:
    if opt.dtype_out not in ("float32", "uint8"):
        raise ValueError(f"dtype_out is '{opt.dtype_out}': one of float32, uint8")
    for known, what, asked in (
        (_DEPTHS, "depth mode", opt.depth),
        (_SCORES, "score kind", [spec.kind for spec in opt.scores]),
    ):
        for name in asked:
            if name not in known:
                raise ValueError(f"unknown {what} '{name}': one of {', '.join(known)}")
    return _all_of(
        Feature.ANTIALIAS if opt.antialias else None,
        Feature.ABSGRAD if opt.absgrad else None,
        Feature.FRAGMENT_GRAD if opt.fragment_grad else None,
        Feature.NORMALS if opt.normals else None,
        Feature.DISTORTION if opt.distortion else None,
        Feature.ALPHA_MAP if opt.alpha else None,
        None if opt.clamp_color else Feature.NO_COLOR_CLAMP,
        Feature.FISHER if opt.fisher else None,
        Feature.UINT8_OUT if opt.dtype_out == "uint8" else None,
        Feature.BACKWARD if opt.grad2d else None,
        Feature.SCORE_PIXEL_WEIGHT if any(spec.pixel_weight is not None for spec in opt.scores) else None,
        *(_DEPTHS[mode] for mode in opt.depth),
        *(_SCORES[spec.kind] for spec in opt.scores),
    )
