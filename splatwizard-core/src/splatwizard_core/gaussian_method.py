"""Methods whose result is a set of Gaussians, and whose file any codec of Gaussians may write."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_core.coding.gaussian_codec import check_gaussian_codec, decode_gaussians, encode_gaussians
from splatwizard_core.errors import SceneError
from splatwizard_core.method import Method

if TYPE_CHECKING:
    import torch

    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.scene.scene import Scene
    from splatwizard_core.training.params import OptimizationParams


class GaussianMethod(Method):
    """Base of methods that leave it to a codec how their Gaussians are written, as those do that only prune.

    A subclass says in `stages` how it trains; its Config has a key `codec`, the name of the codec. Its first stage
    starts from a trained scene, or it has a `create_model` of its own.
    """

    def __init__(self, plugins: PluginManager, config: OptimizationParams | None) -> None:
        """Raises ConfigError for a codec that is not installed: now, and not when all is trained."""
        super().__init__(plugins, config)
        if config is not None:
            check_gaussian_codec(plugins, self.config.codec)

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Raise SceneError: a stage starts from a trained scene, and there is no start from points."""
        named = next((stage.starts_from for stage in self.stages() if stage.starts_from is not None), None)
        start = f"a trained {named} scene" if named is not None else "a trained scene"
        raise SceneError(f"{self.name} starts from {start}, not from points", path=scene.path)

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write `model` with the codec of the config. Raises TypeError if it is no GaussianModel."""
        encode_gaussians(self.plugins, self.config.codec, model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        """The model, by whichever codec has written it. Raises BitstreamError."""
        self.check_version(reader)
        return decode_gaussians(self.plugins, reader)
