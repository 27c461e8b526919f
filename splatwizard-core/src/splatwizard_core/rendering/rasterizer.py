"""The rasterizer contract: what can be asked of one, what comes back, and what each declares of itself."""

from __future__ import annotations

import enum
import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.scene.camera import Camera


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
    RAW_PARAMS = enum.auto()
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
    SCORE_BLEND_MAX = enum.auto()
    SCORE_GAMMA = enum.auto()
    SCORE_DIST = enum.auto()
    SCORE_PIXEL_WEIGHT = enum.auto()
    SCORE_GRAD_SQ = enum.auto()
    FISHER = enum.auto()
    TIGHT_TILES = enum.auto()
    FLOAT64 = enum.auto()
    BATCH = enum.auto()
    DETERMINISTIC = enum.auto()
    UINT8_OUT = enum.auto()
    CAMERA_GRAD = enum.auto()


@dataclass(frozen=True)
class ScoreSpec:
    """One per-Gaussian sum over pixels (and views) that a rasterizer should return.

    name            key in RenderResult.scores
    kind            "hits", "opacity", "opacity_T", "blend", "blend_max", "gamma", "dist", "grad_sq"
    pixel_weight    optional [H,W] float or bool factor per pixel
    rule            "blended", or "tested": also the splat that triggers the stop ("grad_sq" knows only the first)
    gamma           exponent of kind "gamma": alpha^(2g) T^(2-2g)
    """

    name: str
    kind: str
    pixel_weight: Tensor | None = None
    rule: str = "blended"
    gamma: float = 0.5


@dataclass(frozen=True, eq=False)
class RasterOptions:
    """How to draw. Whatever is asked for is in the result; whatever is not is None.

    background      [C] or [C,H,W]; None is 0
    scale_modifier  multiplies the scales (1 in training)
    profile         constants and quirks: "3dgs", "gsplat" or "dgr-exact"
    antialias       opacity compensation of the low-pass filter
    eps2d           low-pass added to both diagonal entries of the 2-D covariance, px^2
    depth           any of "inverse", "accumulated", "expected", "median"
    grad2d, absgrad densification statistics, filled by the backward pass, NDC units
    clamp_grad      "exact": no gradient where alpha is clamped at 0.99; "pass": as the original
    """

    background: Tensor | None = None
    scale_modifier: float = 1.0
    profile: str = "3dgs"
    antialias: bool = False
    eps2d: float = 0.3
    depth: frozenset[str] = frozenset()
    normals: bool = False
    distortion: bool = False
    alpha: bool = False
    clamp_color: bool = True
    grad2d: bool = False
    absgrad: bool = False
    clamp_grad: str = "exact"
    features_detach_geometry: bool = False
    scores: tuple[ScoreSpec, ...] = ()
    fisher: bool = False
    dtype_out: str = "float32"


class GradBuffer:
    """A per-Gaussian statistic that the backward pass fills.

    value   [N,2] in NDC units (pixel gradient times half the image size); reading it before
            `backward` raises RuntimeError
    """

    def __init__(self) -> None:
        self._value: Tensor | None = None

    @property
    def value(self) -> Tensor:
        """[N,2] in NDC units. Raises RuntimeError before `backward`."""
        if self._value is None:
            raise RuntimeError("the screen-space gradient is only there after backward()")
        return self._value

    def set(self, value: Tensor) -> None:
        """Called once by the rasterizer's backward pass."""
        self._value = value.detach()


@dataclass
class RasterStats:
    """Counters of one render call; None where the rasterizer does not count."""

    n_visible: int | None = None
    n_pairs: int | None = None
    n_evaluated: int | None = None
    n_blended: int | None = None
    n_pixels: int | None = None
    n_invalid: int | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class RenderResult:
    """One rendered view, the inputs that were drawn, and what the model said about them.

    image       [C,H,W]
    radii       [N] int32, pixels, 0 = culled (the classic definition in every family)
    visible     [N] bool
    alpha       [1,H,W] | None
    depth       each [1,H,W]: the modes that were asked for, no others
    normals     [3,H,W] camera frame | None
    distortion  [1,H,W] | None
    features    [E,H,W] | None
    grad2d, absgrad2d   .value [N,2] in NDC units, valid after backward | None
    scores      ScoreSpec.name -> [N] float32 (hits: int32)
    fisher      [N,21] | None: upper triangle, row by row, of the sum over pixels and channels of g g^T,
                g = d image / d (mean, log scale)
    inputs      the GaussianInputs that were drawn
    """

    image: Tensor
    radii: Tensor
    inputs: GaussianInputs
    alpha: Tensor | None = None
    depth: dict[str, Tensor] = field(default_factory=dict)
    normals: Tensor | None = None
    distortion: Tensor | None = None
    features: Tensor | None = None
    grad2d: GradBuffer | None = None
    absgrad2d: GradBuffer | None = None
    scores: dict[str, Tensor] = field(default_factory=dict)
    fisher: Tensor | None = None
    stats: RasterStats = field(default_factory=RasterStats)

    @property
    def visible(self) -> Tensor:
        """[N] bool: what was not culled."""
        return self.radii > 0

    @property
    def extras(self) -> dict[str, Any]:
        """What the model attached to the inputs it made."""
        return self.inputs.extras


@dataclass
class AccumOutput:
    """Per-Gaussian sums over several views; no image is kept.

    scores  ScoreSpec.name -> [N]
    fisher  [N,21] | None
    """

    scores: dict[str, Tensor]
    fisher: Tensor | None = None


@dataclass(frozen=True)
class DeviceInfo:
    """How a rasterizer differs on one device: features it lacks there, another probe, another speed."""

    lacks: frozenset[str] = frozenset()
    available: str | None = None
    speed: int | None = None


@dataclass(frozen=True)
class RasterizerInfo:
    """What a rasterizer declares of itself in its registry entry; readable without torch or a compiler.

    available       "module:function" of a cheap probe () -> str | None, the reason why it cannot run here;
                    it must not compile anything. None: always available
    exactness       "exact", "tight" (differs only by the classic clipping), "approx-fp16", "approx-uint8"
    speed           rank within a device, higher is faster
    min_cc          lowest CUDA compute capability
    needs           features that every request must hold: a rasterizer of surfels draws nothing else
    per_device      device -> what is different there; see `on`
    """

    name: str
    devices: frozenset[str]
    dtypes: frozenset[str]
    features: frozenset[str]
    available: str | None = None
    combos_forbidden: tuple[frozenset[str], ...] = ()
    exactness: str = "exact"
    speed: int = 0
    min_cc: tuple[int, int] | None = None
    needs: frozenset[str] = frozenset()
    per_device: Mapping[str, DeviceInfo] = field(default_factory=dict)

    def on(self, device: str) -> RasterizerInfo:
        """What it declares for one device kind ("cpu", "cuda")."""
        here = self.per_device.get(device)
        if here is None:
            return self
        known: dict[str, RasterizerInfo] = vars(self).setdefault("_on", {})  # asked for at every render
        if device not in known:
            known[device] = replace(
                self,
                features=self.features - here.lacks,
                available=here.available or self.available,
                speed=self.speed if here.speed is None else here.speed,
                per_device={},
            )
        return known[device]


@runtime_checkable
class Rasterizer(Protocol):
    """Draws Gaussians. Asked for something it does not declare it raises CapabilityError."""

    info: RasterizerInfo

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; differentiable where `info.features` holds BACKWARD."""
        ...

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from geometry alone (no colour, no gradient); 0 = culled."""
        ...

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum the scores that `opt` asks for over several views."""
        ...


_DEPTH_FEATURES = {
    "inverse": Feature.DEPTH_INVERSE,
    "accumulated": Feature.DEPTH_ACCUM,
    "expected": Feature.DEPTH_EXPECTED,
    "median": Feature.DEPTH_MEDIAN,
}
_SCORE_FEATURES = {
    "hits": Feature.SCORE_HITS,
    "opacity": Feature.SCORE_OPACITY,
    "opacity_T": Feature.SCORE_OPACITY_T,
    "blend": Feature.SCORE_BLEND,
    "blend_max": Feature.SCORE_BLEND_MAX,
    "gamma": Feature.SCORE_GAMMA,
    "dist": Feature.SCORE_DIST,
    "grad_sq": Feature.SCORE_GRAD_SQ,
}


def option_features(opt: RasterOptions) -> Feature:
    """The features that these options ask for, whatever is drawn."""
    known = vars(opt).get("_asked")  # options do not change, and a training renders with the same at every step
    if known is None:
        known = vars(opt)["_asked"] = _read_off(opt)
    return known


def _read_off(opt: RasterOptions) -> Feature:
    required = Feature(0)
    for asked, feature in (
        (opt.antialias, Feature.ANTIALIAS),
        (opt.absgrad, Feature.ABSGRAD),
        (opt.normals, Feature.NORMALS),
        (opt.distortion, Feature.DISTORTION),
        (opt.alpha, Feature.ALPHA_MAP),
        (not opt.clamp_color, Feature.NO_COLOR_CLAMP),
        (opt.fisher, Feature.FISHER),
        (opt.dtype_out == "uint8", Feature.UINT8_OUT),
        (opt.grad2d, Feature.BACKWARD),
    ):
        if asked:
            required |= feature
    if opt.dtype_out not in ("float32", "uint8"):
        raise ValueError(f"dtype_out is '{opt.dtype_out}': one of float32, uint8")
    for mode in opt.depth:
        if mode not in _DEPTH_FEATURES:
            raise ValueError(f"unknown depth mode '{mode}': one of {', '.join(_DEPTH_FEATURES)}")
        required |= _DEPTH_FEATURES[mode]
    for spec in opt.scores:
        if spec.kind not in _SCORE_FEATURES:
            raise ValueError(f"unknown score kind '{spec.kind}': one of {', '.join(_SCORE_FEATURES)}")
        required |= _SCORE_FEATURES[spec.kind]
        if spec.pixel_weight is not None:
            required |= Feature.SCORE_PIXEL_WEIGHT
    return required


def required_features(g: GaussianInputs, opt: RasterOptions) -> Feature:
    """Everything that drawing `g` with `opt` needs, read off mechanically."""
    required = option_features(opt)
    if g.requires_grad():
        required |= Feature.BACKWARD
    if g.cov3d is not None:
        required |= Feature.COV3D
    if g.geom_indices is not None or g.scale_factors is not None:
        required |= Feature.INDEXED_GEOM
    if g.features is not None:
        required |= Feature.EXTRA_FEATURES
    if g.colors is not None and g.colors.shape[-1] != 3:
        required |= Feature.COLORS_ND
    if g.sh is not None:
        if g.sh.codebook is not None:
            required |= Feature.INDEXED_SH
        if g.sh.dc is not None:
            required |= Feature.SPLIT_SH
    if g.scales is not None and g.scales.shape[-1] == 2:
        required |= Feature.SURFEL
    if g.means.dtype == torch.float64:
        required |= Feature.FLOAT64
    return required


@functools.cache
def feature_names(features: Feature) -> frozenset[str]:
    """{"BACKWARD", ...} for a set of flags."""
    return frozenset(f.name for f in Feature if f in features and f.name is not None)


def check_offered(info: RasterizerInfo, required: Feature) -> None:
    """Raise CapabilityError unless `info` declares everything in `required`; rasterizers call it first."""
    wanted = feature_names(required)
    missing = wanted - info.features
    if missing:
        raise CapabilityError(
            f"rasterizer '{info.name}' does not offer {', '.join(sorted(missing))}; "
            "`sw list-plugins` shows which one does",
            missing=missing,
        )
    if not info.needs <= wanted:
        raise CapabilityError(
            f"rasterizer '{info.name}' draws nothing without {', '.join(sorted(info.needs - wanted))}; "
            "`sw list-plugins` shows which one draws the rest",
            missing=frozenset(),
        )
    for combo in info.combos_forbidden:
        if combo <= wanted:
            raise CapabilityError(
                f"rasterizer '{info.name}' does not offer {' and '.join(sorted(combo))} together", missing=combo
            )
