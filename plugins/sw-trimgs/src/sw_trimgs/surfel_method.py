"""TrimGS on surfels: fine-tuned from a 2DGS scene, or trained with trims from the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod

from splatwizard_core.api import ConfigError, Method, create_method
from sw_trimgs.presets import RATES, SCRATCH_PRESETS, SURFEL_PRESETS
from sw_trimgs.surfel_config import ScratchConfig, Trim2DGSConfig
from sw_trimgs.surfel_stage import ScratchStage, TrimSurfelStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import Scene, SplatModel, Stage

NO_SIZE_RULE = 1e9
"""Scale, times the extent, above which 2DGS prunes: TrimGS has no such rule when it trains from the start."""


class Trim2DGS(GaussianMethod):
    """Fan, Yang, Li, Li, Zhang: Trim 3D Gaussian Splatting (arXiv 2406.07499), on the surfels of a 2DGS scene."""

    name: ClassVar[str] = "trim-2dgs"
    version: ClassVar[int] = 1
    Config = Trim2DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = SURFEL_PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"

    def stages(self) -> Sequence[Stage]:
        return [TrimSurfelStage(self.config, self.plugins)]


class Trim2DGSScratch(GaussianMethod):
    """The same without a scene before it: the plan of 2DGS with scale splits and trims; as the authors' code has it."""

    name: ClassVar[str] = "trim-2dgs-scratch"
    version: ClassVar[int] = 1
    Config = ScratchConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = SCRATCH_PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"

    def _base(self) -> Method:
        """Return the configured 2dgs: its start and its stage. Raises ConfigError for values that are ours to set."""
        config: ScratchConfig = self.config
        values = dict(config.base)
        preset = str(values.pop("preset", "paper"))
        own: dict[str, Any] = {
            "iterations": config.iterations,
            "scale_schedule": config.scale_schedule,
            "surface.lambda_dist": config.surface.lambda_dist,
            "surface.lambda_normal": 0.0,  # ours leaves out edges
        }
        density = values.get("density", {})
        if density == "adc" or (isinstance(density, Mapping) and density.get("name", "adc") == "adc"):
            own["density.settings.world_prune"] = NO_SIZE_RULE
        if config.surface.depth_ratio is not None:
            own["surface.depth_ratio"] = config.surface.depth_ratio
        taken = next((key for key in own if _holds(values, key)), None)
        if taken is not None:
            raise ConfigError(
                f"'base.{taken}' is set by trim-2dgs-scratch itself: leave it out ('surface', 'iterations' and "
                "'scale_schedule' of its own are what can be set)",
                key="base",
            )
        return create_method(self.plugins, "2dgs", {**own, **values}, preset=preset)

    def borrows(self) -> Sequence[Method]:
        return [self._base()]

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        return self._base().create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        return [ScratchStage(self.config, self._base(), self.plugins)]


def _holds(values: Mapping[str, Any], key: str) -> bool:
    """Whether nested blocks of values, or dotted keys, say something of the dotted `key`."""
    if key in values:
        return True
    block, _, rest = key.partition(".")
    return bool(rest) and isinstance(values.get(block), Mapping) and _holds(values[block], rest)
