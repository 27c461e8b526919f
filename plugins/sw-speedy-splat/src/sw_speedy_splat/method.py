"""Speedy-Splat: Fast 3D Gaussian Splatting with Sparse Pixels and Sparse Primitives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod
from sw_gaussians.older_keys import flattened
from sw_gaussians.quick import LONGER

from splatwizard_core.api import Method, create_method
from sw_speedy_splat.config import SpeedySplatConfig
from sw_speedy_splat.presets import PRESETS, RATES
from sw_speedy_splat.stage import SpeedySplatStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import Scene, SplatModel, Stage


class SpeedySplat(GaussianMethod):
    """Hanson, Tu, Lin, Singla, Zwicker, Goldstein: Speedy-Splat, CVPR 2025 (arXiv 2412.00578)."""

    name: ClassVar[str] = "speedy-splat"
    version: ClassVar[int] = 1
    Config = SpeedySplatConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"  # the published shares

    def _base(self) -> Method:
        """Return the configured 3DGS: its start and its stage."""
        values = flattened(self.config.base)
        preset = str(values.pop("preset", "paper"))
        # Runs by the quick plan of 2,500 steps named the preset of 3dgs, which has other values since.
        if preset == "quick" and values.get("lr.max_steps") == 2_500 and "sh_interval" not in values:
            values = {**LONGER, **values}
        length = {"iterations": self.config.iterations, "scale_schedule": self.config.scale_schedule}
        return create_method(self.plugins, "3dgs", {**length, **values}, preset=preset)

    def borrows(self) -> Sequence[Method]:
        return [self._base()]

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        return self._base().create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        return [SpeedySplatStage(self.config, self._base(), self.plugins)]
