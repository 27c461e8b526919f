"""Methods whose result is a set of Gaussians, and whose file any codec of Gaussians may write."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import ConfigError, GaussianModel, Method, SceneError

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import (
        ContainerReader,
        ContainerWriter,
        OptimizationParams,
        PluginManager,
        Scene,
        SplatModel,
    )

HEADER_KEY = "codec"
"""Header value that names the codec."""


class GaussianMethod(Method):
    """Base of methods that leave it to a codec how their Gaussians are written, as those do that only prune.

    A subclass says in `stages` how it trains; its Config has a key `codec`, the name of the codec, or it says in
    `codec_choice` where the codec and its settings stand. Its first stage starts from a trained scene, or it has a
    `create_model` of its own.

    CODEC_KEY   key of the config that names the codec
    """

    CODEC_KEY: ClassVar[str] = "codec"

    def __init__(self, plugins: PluginManager, config: OptimizationParams | None) -> None:
        """Raise ConfigError for a codec that is not installed: now, and not when all is trained."""
        super().__init__(plugins, config)
        if config is None:
            return
        name, known = self.codec_choice()[0], plugins.gaussian_codecs.names
        if name not in known:
            raise ConfigError(
                f"no codec for Gaussians is called '{name}'; installed: {', '.join(known)}", key=self.CODEC_KEY
            )

    def codec_choice(self) -> tuple[str, Mapping[str, Any]]:
        """Return the name of the codec and its settings, from the config."""
        return self.config.codec, {}

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Raise SceneError: a stage starts from a trained scene, and there is no start from points."""
        named = next((stage.starts_from for stage in self.stages() if stage.starts_from is not None), None)
        start = f"a trained {named} scene" if named is not None else "a trained scene"
        raise SceneError(f"{self.name} starts from {start}, not from points", path=scene.path)

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write `model` with the chosen codec, whose name goes into the header.

        Raises TypeError if it is no GaussianModel, PluginError if the codec cannot be loaded.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"{self.name} encodes a GaussianModel, not a {type(model).__name__}")
        name, settings = self.codec_choice()
        writer.static[HEADER_KEY] = name
        self.plugins.gaussian_codecs.load(name)(self.plugins, **settings).encode(model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        """Return the model, by whichever codec has written it. Raises BitstreamError."""
        self.check_version(reader)
        name = reader.text(HEADER_KEY, choices=self.plugins.gaussian_codecs.names)
        return self.plugins.gaussian_codecs.load(name)(self.plugins).decode(reader)
