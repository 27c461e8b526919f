"""TrimGS on ellipsoids: 3DGS with flat Gaussians, and the fine-tuning that trims them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod
from sw_gaussians.start import gaussians_from_points, start_points

from sw_trimgs.config import FlatConfig, Trim3DGSConfig
from sw_trimgs.flat import FlatGaussians
from sw_trimgs.presets import FLAT_PRESETS, PRESETS, RATES
from sw_trimgs.stage import FlatStage, TrimFlatStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerWriter, Scene, SplatModel, Stage

MEDIAN = 1.0
"""Depth ratio of a surface that is the median depth, for who makes a mesh of it."""


class Flat3DGS(GaussianMethod):
    """3DGS whose Gaussians are flat from the first step on: two scales are learned, the third is 1e-8.

    The first stage of Trim3DGS (arXiv 2406.07499), a method of its own so that its scene is trained once and can be
    compared with what trimming makes of it.
    """

    name: ClassVar[str] = "flat-3dgs"
    version: ClassVar[int] = 1
    Config = FlatConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = FLAT_PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Flat Gaussians, one for each start point of the scene, all facing along x. Raises SceneError."""
        config: FlatConfig = self.config
        points = start_points(scene, self.name)
        start = config.density.load(self.plugins).start_values()
        round_ones = gaussians_from_points(points, max_sh_degree=config.sh_degree, **start)
        tensors = [getattr(round_ones, name).detach() for name in round_ones.RAW]
        return FlatGaussians(*tensors, active_sh_degree=0)

    def stages(self) -> Sequence[Stage]:
        config: FlatConfig = self.config
        control, pictures = config.density.load(self.plugins), config.pictures.load(self.plugins)
        return [FlatStage(config, control, pictures=pictures)]


class Trim3DGS(GaussianMethod):
    """Fan, Yang, Li, Li, Zhang: Trim 3D Gaussian Splatting for Accurate Geometry Representation, 2024.

    1. START    flat Gaussians, trained as in 3DGS
    2. TUNE     7,000 steps: split what is large, trim what contributes least, let normals follow the depth

    Source: arXiv 2406.07499, and the authors' code where the two differ.
    """

    name: ClassVar[str] = "trim-3dgs"
    version: ClassVar[int] = 1
    Config = Trim3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"

    def stages(self) -> Sequence[Stage]:
        return [TrimFlatStage(self.config, self.plugins)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write `model` with the chosen codec, and that its surface is the median depth: the authors mesh with it."""
        super().encode(model, writer)
        writer.static["depth_ratio"] = MEDIAN
