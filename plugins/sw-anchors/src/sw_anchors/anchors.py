"""Anchor model of Scaffold-GS: anchors that spawn k Gaussians per view through small networks.

`AnchorSplats` only decodes, `AnchorModel` is trained; see also `coded_anchors` and `decoded_anchors`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.knn import mean_squared_neighbor_distance
from torch import Tensor, nn

from splatwizard_core.api import (
    Camera,
    GaussianInputs,
    PointCloud,
    SceneError,
    ShapeError,
    SplatModel,
)
from sw_anchors.fast import spawn as fast_spawn
from sw_anchors.neural_gaussians import GEOMETRY, NeuralGaussians, spawn
from sw_anchors.shape import AnchorShape
from sw_codecs.context.two_layers import two_layers

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

MIN_SQUARED_DISTANCE = 1e-7
"""Floor of the squared neighbour distance that initialises anchor scales, world units squared."""


@dataclass(frozen=True)
class AnchorAttributes:
    """Attributes of V anchors as inputs of the networks: raw, noisy or dequantised, by training phase.

    positions   [V,3] world units
    features    [V,F]
    offsets     [V,k,3] in units of the first three scales
    scales      [V,6] linear: three multiply offsets, three are the base scales of the Gaussians, world units
    masks       [V,k] multiplies the opacities (0 removes a Gaussian), or None
    extras      what belongs to these very values and losses want to see: their rate under the noise that was drawn
    """

    positions: Tensor
    features: Tensor
    offsets: Tensor
    scales: Tensor
    masks: Tensor | None = None
    extras: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class AnchorSelection:
    """Anchors and Gaussians that one view drew; `RenderResult.extras["anchors"]`.

    rows        [V] int64, visible anchors
    opacities   [V,k] in (-1,1), all offsets of the visible anchors, detached
    drawn       [M] int64, index into the V * k offsets of each Gaussian that was drawn
    """

    rows: Tensor
    opacities: Tensor
    drawn: Tensor

    def offset_index(self) -> Tensor:
        """[M] int64: index into the N * k offsets of the model."""
        k = self.opacities.shape[1]
        return self.rows[self.drawn // k] * k + self.drawn % k


class AnchorSplats(SplatModel):
    """Base of all anchor models: selects visible anchors and decodes Gaussians. Subclasses store attributes.

    mlp_opacity, mlp_cov, mlp_color     from (feature, direction, distance) to k values, 7 k, 3 k; one hidden layer

    Source: Scaffold-GS (arXiv 2312.00109) as used by HAC (arXiv 2403.14530).
    """

    ROW_LABEL = "anchors"
    NETWORKS: tuple[str, ...] = ("mlp_opacity", "mlp_cov", "mlp_color")

    mlp_opacity: nn.Sequential
    mlp_cov: nn.Sequential
    mlp_color: nn.Sequential

    _opaque: tuple[Any, Tensor, Tensor] | None = None

    def make_networks(self, features: int, offsets: int, hidden: int, generator: torch.Generator, like: Tensor) -> None:
        """Make the three networks, at random from `generator`, with device and dtype of `like`."""
        for name, outputs in zip(self.NETWORKS, (1, GEOMETRY, 3), strict=True):
            setattr(self, name, two_layers(features + 4, hidden, outputs * offsets, generator).to(like))

    @torch.no_grad()
    def show_offsets(self, count: int, eyes: Tensor) -> None:
        """Initialise the opacity network so that `count` offsets of an anchor are visible, at most half of them.

        eyes    [C,3] camera centres

        New anchors have equal features, so an offset is visible for all anchors or for none. With random weights the
        number of visible offsets (of ten) depends on the seed: 1.6 to 8.7 on average over views. Here offset
        `count` + j gets minus the output of j < `count`; of the others, those that are positive on average change sign.
        """
        first, last = linear_layers(self.mlp_opacity)
        count = min(count, self.num_offsets // 2)
        toward = self.positions().mean(dim=0) - eyes.to(first.weight)
        distance = torch.linalg.vector_norm(toward, dim=1, keepdim=True)
        features = first.weight.new_zeros(len(eyes), first.in_features - 4)
        outputs = self.mlp_opacity(torch.cat([features, toward / distance, distance], dim=1)).mean(dim=0)
        for parameter in (last.weight, last.bias):
            parameter[outputs > 0] = -parameter[outputs > 0]
            parameter[:count] = -parameter[count : 2 * count]

    @property
    def num_offsets(self) -> int:
        """k, the number of Gaussians per anchor."""
        raise NotImplementedError

    def positions(self) -> Tensor:
        """Positions [N,3] of the anchors, world units."""
        raise NotImplementedError

    def reach(self) -> Tensor:
        """Extent [N,3] of an anchor's offsets per axis, world units; for the visibility test."""
        raise NotImplementedError

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        """Return the attributes of the anchors `rows` [V] as network inputs; differentiable."""
        raise NotImplementedError

    @torch.no_grad()
    def balls(self) -> GaussianInputs:
        """Return an opaque ellipsoid per anchor, for the rasterizer's visibility test."""
        positions = self.positions()
        key = (len(positions), positions.dtype, positions.device)
        if self._opaque is None or self._opaque[0] != key:
            # Made on the CPU, and anew at each step, they would have to be waited for on a GPU.
            one, identity = positions.new_ones(1), torch.eye(1, 4, dtype=positions.dtype, device=positions.device)
            self._opaque = (key, one.expand(len(positions)), identity.repeat(len(positions), 1))
        _, opacities, quats = self._opaque
        return GaussianInputs(positions, opacities, self.reach(), quats, colors=positions)

    @torch.no_grad()
    def visible_anchors(self, camera: Camera, rasterizer: Rasterizer) -> Tensor:
        """Return the anchors [V] int64 whose ellipsoid of offset scales reaches the image."""
        return torch.nonzero(rasterizer.visible_filter(self.balls(), camera) > 0).squeeze(1)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """Return the Gaussians of the visible anchors; `extras["anchors"]` is the AnchorSelection."""
        return self.decode(camera, self.visible_anchors(camera, rasterizer))

    @property
    def num_gaussian_ids(self) -> int:
        """Largest number of Gaussians: N k."""
        return self.num_rows * self.num_offsets

    def gaussian_ids(self, inputs: GaussianInputs) -> Tensor:
        """Return, per Gaussian of `gaussians(...)`, its index [M] int64 into the N k offsets; for baking."""
        selection: AnchorSelection = inputs.extras["anchors"]
        return selection.offset_index()

    def decode(self, camera: Camera, rows: Tensor) -> GaussianInputs:
        """Return the Gaussians of the anchors `rows` [V] as `camera` sees them, without those of opacity <= 0."""
        a = self.attributes(rows)
        given = (camera.center.to(a.positions), a.positions, a.features, a.offsets, a.scales, a.masks)
        decode = fast_spawn.spawn if fast_spawn.fits(*given[1:]) else spawn
        return self.drawn(rows, decode(*given, (self.mlp_opacity, self.mlp_cov, self.mlp_color)), a.masks, a.extras)

    def drawn(
        self, rows: Tensor, found: NeuralGaussians, masks: Tensor | None, extras: dict[str, Any]
    ) -> GaussianInputs:
        """Return spawned Gaussians of the anchors `rows` [V], with `masks` [V or more, k], as rasterizer inputs."""
        return GaussianInputs(
            means=found.means,
            opacities=found.opacities,
            scales=found.scales,
            quats=found.quats,
            colors=found.colors,
            extras={**extras, "anchors": AnchorSelection(rows, found.all_opacities[: len(rows)], found.drawn)},
        )


class AnchorModel(AnchorSplats):
    """The Scaffold-GS model: N anchors with k offsets each, usable as it is or subclassed.

    anchors         [N,3] world units, on a lattice of `voxel_size` when made from points
    features        [N,F]
    offsets         [N,k,3]
    log_scales      [N,6]
    opacity_accum, anchor_denom         [N] buffers: sum of max(opacity, 0) of an anchor's offsets, views seen in
    offset_grad_accum, offset_denom     [N,k] buffers: sum of screen-space gradients (NDC), views drawn in

    A method that quantises or masks overrides `positions` and `attributes`; one with further parameters per row also
    extends ROWS and `rows_at`. Source: Scaffold-GS (arXiv 2312.00109) as used by HAC (arXiv 2403.14530).
    """

    ROWS: tuple[str, ...] = (
        "anchors", "features", "offsets", "log_scales",
        "opacity_accum", "anchor_denom", "offset_grad_accum", "offset_denom",
    )  # fmt: skip

    anchors: nn.Parameter
    features: nn.Parameter
    offsets: nn.Parameter
    log_scales: nn.Parameter
    opacity_accum: Tensor
    anchor_denom: Tensor
    offset_grad_accum: Tensor
    offset_denom: Tensor

    def __init__(
        self,
        anchors: Tensor,
        features: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
        *,
        voxel_size: float,
        hidden: int = 50,
        generator: torch.Generator,
    ) -> None:
        """Take the tensors as they are; networks of one hidden layer start at random from `generator`.

        Raises ShapeError if the tensors do not fit together.
        """
        super().__init__()
        n = anchors.shape[0]
        for name, tensor, tail in (
            ("anchors", anchors, (3,)),
            ("features", features, (-1,)),
            ("offsets", offsets, (-1, 3)),
            ("log_scales", log_scales, (6,)),
        ):
            fits = tensor.dim() == 1 + len(tail) and tensor.shape[0] == n
            fits = fits and all(e in (-1, a) for a, e in zip(tensor.shape[1:], tail, strict=True))
            if not fits:
                expected = (n, *("any" if e == -1 else e for e in tail))
                raise ShapeError(f"AnchorModel.{name} must be {list(expected)}, got {list(tensor.shape)}")
            self.register_parameter(name, nn.Parameter(tensor.detach()))
        k = offsets.shape[1]
        for name, shape in (
            ("opacity_accum", (n,)), ("anchor_denom", (n,)), ("offset_grad_accum", (n, k)), ("offset_denom", (n, k)),
        ):  # fmt: skip
            self.register_buffer(name, torch.zeros(shape, dtype=anchors.dtype, device=anchors.device))
        self.voxel_size = voxel_size
        self.make_networks(features.shape[1], k, hidden, generator, anchors)

    @classmethod
    def from_points(
        cls,
        points: PointCloud,
        *,
        voxel_size: float,
        num_offsets: int = 10,
        feature_dim: int = 50,
        generator: torch.Generator,
        **kwargs: Any,
    ) -> AnchorModel:
        """Make one anchor per voxel of size `voxel_size` that holds a point.

        voxel_size  world units; <= 0: the median over points of the mean *squared* distance to three neighbours
                    (as published: the square is kept)
        kwargs      further arguments of the constructor

        Raises SceneError if no finite point is there or all coincide.
        """
        xyz = torch.as_tensor(points.xyz, dtype=torch.float32)
        xyz = xyz[torch.isfinite(xyz).all(dim=1)]
        if not len(xyz):
            raise SceneError("the scene has no finite point to put anchors at")
        if voxel_size <= 0:
            voxel_size = float(mean_squared_neighbor_distance(xyz).median())
            if voxel_size <= 0:
                raise SceneError("most points of the scene coincide: set the voxel size")
        anchors = torch.unique(torch.round(xyz / voxel_size), dim=0) * voxel_size
        n = len(anchors)
        spacing = mean_squared_neighbor_distance(anchors).clamp(min=MIN_SQUARED_DISTANCE).sqrt()
        return cls(
            anchors,
            torch.zeros(n, feature_dim),
            torch.zeros(n, num_offsets, 3),
            spacing.log()[:, None].repeat(1, 6),
            voxel_size=voxel_size,
            generator=generator,
            **kwargs,
        )

    @property
    def num_offsets(self) -> int:
        return self.offsets.shape[1]

    @property
    def shape(self) -> AnchorShape:
        """Numbers of features and offsets per anchor."""
        return AnchorShape(self.features.shape[1], self.num_offsets)

    def counts(self) -> dict[str, int]:
        """Number of anchors, and of Gaussians that they could spawn."""
        return {"num_anchors": self.num_rows, "num_gaussians": self.num_rows * self.num_offsets}

    def positions(self) -> Tensor:
        return self.anchors

    def reach(self) -> Tensor:
        return self.log_scales[:, :3].exp()

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        return AnchorAttributes(
            self.positions()[rows], self.features[rows], self.offsets[rows], self.log_scales[rows].exp()
        )

    def holds(self, positions: Tensor) -> Tensor | None:
        """Return [M] bool: whether new anchors may be placed at `positions` [M,3], M > 0; None: anywhere."""
        return None

    def rows_at(self, positions: Tensor, features: Tensor, size: float) -> dict[str, Tensor]:
        """Return parameters of new anchors at `positions` [M,3] with `features` [M,F], voxels of `size` world units."""
        m = len(positions)
        return {
            "anchors": positions,
            "features": features,
            "offsets": positions.new_zeros(m, self.num_offsets, 3),
            "log_scales": positions.new_full((m, 6), math.log(size)),
        }

    def state_dict_extra(self) -> dict[str, Any]:
        """Return the voxel size, which may be computed from the points."""
        return {"voxel_size": self.voxel_size}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        """Inverse of `state_dict_extra`."""
        self.voxel_size = float(extra["voxel_size"])


def linear_layers(network: nn.Sequential) -> tuple[nn.Linear, nn.Linear]:
    """Return both linear layers of a network Linear, ReLU, Linear."""
    first, _, last = network
    assert isinstance(first, nn.Linear)
    assert isinstance(last, nn.Linear)
    return first, last
