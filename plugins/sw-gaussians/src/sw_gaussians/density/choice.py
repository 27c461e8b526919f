"""Configuration block that chooses a density control by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from splatwizard_core.api import PluginError
from sw_gaussians.choices import Choice
from sw_gaussians.density.adc import AdaptiveDensityControl

if TYPE_CHECKING:
    from splatwizard_core.api import DensityControl, PluginManager


class DensityChoice(Choice):
    """Density control, by name, and its settings."""

    REGISTRY: ClassVar[str] = "density_controls"

    name: str = Field("adc", description="density control: any registered one")
    settings: dict[str, object] = Field({}, description="settings of the chosen one, by its own keys")

    def load(self, plugins: PluginManager) -> DensityControl:
        """Return the control with its settings. Raises ConfigError if it is not installed, PluginError."""
        self.provider(plugins, "density.name")
        control: DensityControl = plugins.density_controls.load(self.name)(**self.settings)
        return control

    def usual(self) -> DensityControl:
        """Return the control of 3DGS, for a stage that was given none. Raises PluginError if another one is chosen."""
        if self.name != "adc":
            raise PluginError(
                f"density={self.name} does not reach the training: the author of its method has to make the stage with "
                "ThreeDGSStage(config, config.density.load(plugins))"
            )
        return AdaptiveDensityControl(**self.settings)
