"""The rasterizer contract: options of a drawing, its result, and the protocol of rasterizers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from splatwizard_core.errors import ConfigError, ShapeError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.scene.camera import Camera


@dataclass(frozen=True)
class ScoreSpec:
    """One per-Gaussian sum over pixels (and views) that a rasterizer should return.

    name            key in RenderResult.scores
    kind            "hits", "opacity", "opacity_T", "blend", "blend_sq", "blend_max", "shown", "gamma", "dist",
                    "grad_sq", "removal"
    pixel_weight    optional [H,W] float or bool factor per pixel; not of "removal"
    rule            "blended", or "tested": also the splat that triggers the stop (not of "grad_sq" and "removal")
    gamma           exponent of kind "gamma": alpha^(2g) T^(2-2g)
    residual        of "removal": optional [3,H,W], render minus picture; without it the picture is the render itself
    """

    name: str
    kind: str
    pixel_weight: Tensor | None = None
    rule: str = "blended"
    gamma: float = 0.5
    residual: Tensor | None = None

    @property
    def dtype(self) -> torch.dtype:
        """int32 for counts (also under a mask), float32 for everything else."""
        whole = self.pixel_weight is None or not self.pixel_weight.is_floating_point()
        return torch.int32 if self.kind in ("hits", "shown") and whole else torch.float32


@dataclass(frozen=True, eq=False)
class RasterOptions:
    """Options of one drawing. A map or sum that they ask for is in the result; any other is None.

    background      [C] or [C,H,W]; None is 0
    scale_modifier  multiplies the scales (1 in training)
    profile         a set of constants and quirks that the rasterizer declares; "": its own
    antialias       opacity compensation of the low-pass filter
    eps2d           low-pass added to both diagonal entries of the 2-D covariance, px^2
    depth           any of "inverse", "accumulated", "expected", "median"
    grad2d, absgrad densification statistics, filled by the backward pass, NDC units
    fragment_grad   sums of squared opacity gradients, filled by the backward pass; not together with absgrad
    clamp_grad      "exact": no gradient where alpha is clamped at 0.99; "pass": as the original
    """

    background: Tensor | None = None
    scale_modifier: float = 1.0
    profile: str = ""
    antialias: bool = False
    eps2d: float = 0.3
    depth: frozenset[str] = frozenset()
    normals: bool = False
    distortion: bool = False
    alpha: bool = False
    clamp_color: bool = True
    grad2d: bool = False
    absgrad: bool = False
    fragment_grad: bool = False
    clamp_grad: str = "exact"
    features_detach_geometry: bool = False
    scores: tuple[ScoreSpec, ...] = ()
    fisher: bool = False
    dtype_out: str = "float32"

    def check_scores(self, cam: Camera) -> None:
        """Raise ConfigError for an unknown rule, a map not of the size of `cam` or the kind, two scores of one name."""
        for spec in self.scores:
            rules = ("blended",) if spec.kind in ("grad_sq", "removal") else ("blended", "tested")
            if spec.rule not in rules:
                raise ConfigError(
                    f"score '{spec.name}': rule is '{spec.rule}', must be {' or '.join(map(repr, rules))}"
                )
            for name, leading in (("pixel_weight", ()), ("residual", (3,))):
                given, size = getattr(spec, name), (*leading, cam.height, cam.width)
                if given is not None and (name == "residual") != (spec.kind == "removal"):
                    raise ConfigError(f"score '{spec.name}': kind '{spec.kind}' takes no {name}")
                if given is not None and given.shape != size:
                    raise ConfigError(f"score '{spec.name}': {name} is {list(given.shape)}, must be {list(size)}")
        if len({s.name for s in self.scores}) < len(self.scores):
            raise ConfigError(f"two scores have one name: {', '.join(s.name for s in self.scores)}")

    def background_of(self, channels: int, cam: Camera, like: Tensor) -> Tensor | None:
        """The background, [C] or [C,H,W], with device and dtype of `like`; None is black. Raises ShapeError."""
        if self.background is None:
            return None
        if self.background.shape not in ((channels,), (channels, cam.height, cam.width)):
            raise ShapeError(
                f"background must be [{channels}] or [{channels}, {cam.height}, {cam.width}], "
                f"got {list(self.background.shape)}"
            )
        return self.background.to(like)


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
        if self._value is None or self._value.dim() == 1:
            raise RuntimeError("the screen-space gradient is only there after backward()")
        return self._value

    def set(self, value: Tensor) -> None:
        """Store the gradient, or an empty [0] that the backward pass resizes; a rasterizer calls it once."""
        self._value = value.detach() if value.requires_grad else value


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
    """One rendered view, with the inputs that were drawn and the model's additions to them.

    image       [C,H,W]
    radii       [N] int32, pixels, 0 = culled (the classic definition in every family)
    visible     [N] bool
    alpha       [1,H,W] | None
    depth       each [1,H,W]: the modes that were asked for, no others
    normals     [3,H,W] camera frame | None
    distortion  [1,H,W] | None
    features    [E,H,W] | None
    grad2d, absgrad2d   .value [N,2] in NDC units, valid after backward | None
    fragment_grad       .value [N,2], likewise: over pixels, sum of (o dL/do)^2 of opacity o; how many they are | None
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
    fragment_grad: GradBuffer | None = None
    scores: dict[str, Tensor] = field(default_factory=dict)
    fisher: Tensor | None = None
    stats: RasterStats = field(default_factory=RasterStats)

    @property
    def visible(self) -> Tensor:
        """[N] bool: False for Gaussians that were culled."""
        return self.radii > 0

    @property
    def extras(self) -> dict[str, Any]:
        """The model's own additions to the inputs: `GaussianInputs.extras`."""
        return self.inputs.extras


@dataclass
class AccumOutput:
    """Per-Gaussian sums over several views; no image is kept.

    scores  ScoreSpec.name -> [N]
    fisher  [N,21] | None
    """

    scores: dict[str, Tensor]
    fisher: Tensor | None = None


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
