"""Base class of methods that produce explicit Gaussians and let a chosen codec write the file."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch

from splatwizard_core.api import ContainerWriter, GaussianModel, Method, PluginError, SceneError
from sw_gaussians.choices import CodecChoice
from sw_gaussians.sized import FILLING, Filling, fill, hold_size
from sw_gaussians.start import gaussians_from_points, start_points
from sw_gaussians.surfels import SurfelModel, state_surface, stated_surface

if TYPE_CHECKING:
    from splatwizard_core.api import (
        ContainerReader,
        OptimizationParams,
        PluginManager,
        Scene,
        SplatModel,
    )

HEADER_KEY = "codec"
"""Header value that names the codec."""


class GaussianMethod(Method):
    """Base of methods, such as pruning methods, whose Gaussians are written by an exchangeable codec.

    A subclass says in `stages` how it trains; its Config is a `Choosing` with a block `codec`, a `CodecChoice`. It
    starts from a trained scene where its first stage does, else from the scene's points; one that starts otherwise
    has a `create_model` of its own.
    """

    def __init__(self, plugins: PluginManager, config: OptimizationParams | None) -> None:
        """Raise ConfigError for a missing codec (or part of one) now, before training."""
        super().__init__(plugins, config)
        if config is None:
            return
        codec = getattr(config, "codec", None)
        if not isinstance(codec, CodecChoice):
            raise PluginError(
                f"method '{self.name}' cannot be used: `codec` of its {type(config).__name__} must be a CodecChoice of "
                "sw_gaussians.choices; its author has to change that"
            )
        provider = codec.provider(plugins, "codec.name")
        provider(plugins, **codec.settings)
        if size := str(getattr(config, "size", "")):
            name = getattr(provider, "WRITES", codec.name)
            hold_size(size, _least(plugins, self.name, name), "header and sections of a file")

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Return one Gaussian for each start point, with bands up to `sh_degree` of the config, or 3.

        Raises SceneError for a scene without points, or where a stage starts from a trained scene.
        """
        named = next((stage.starts_from for stage in self.stages() if stage.starts_from is not None), None)
        if named is not None:
            raise SceneError(f"{self.name} starts from a trained {named} scene, not from points", path=scene.path)
        points = start_points(scene, self.name)
        return gaussians_from_points(points, max_sh_degree=getattr(self.config, "sh_degree", 3))

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write `model` with the chosen codec, whose name goes into the header.

        Raises TypeError if it is no GaussianModel, PluginError if the codec cannot be loaded.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"{self.name} encodes a GaussianModel, not a {type(model).__name__}")
        codec: CodecChoice = self.config.codec
        if getattr(self.config, "size", "") and codec.name != FILLING:
            fill(self, model, writer)
            return
        filling = codec.provider(self.plugins, "codec.name")(self.plugins, **codec.settings)
        if isinstance(filling, Filling):
            model, codec = filling.chosen(model, self.name, writer.raster, self.scene)
        writer.static[HEADER_KEY] = codec.name
        state_surface(model, writer)
        codec.load(self.plugins).encode(model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        """Decode the model with the codec that the header names. Raises BitstreamError."""
        self.check_version(reader)
        model = self.plugins.gaussian_codecs.load(self.codec_of(reader))(self.plugins).decode(reader)
        if isinstance(model, SurfelModel):
            model.surface = stated_surface(reader)
        return model

    def codec_of(self, reader: ContainerReader) -> str:
        """Return the name of the codec that the header of a file states. Raises BitstreamError."""
        return reader.text(HEADER_KEY, choices=self.plugins.gaussian_codecs.names)


@functools.cache
def _least(plugins: PluginManager, method: str, codec: str) -> int:
    """Return bytes of a file of one Gaussian by a codec."""
    writer, one = ContainerWriter(method, 1), torch.zeros(1, 3)
    model = GaussianModel(one, one[:, None], one[:, None].repeat(1, 15, 1), one[:, 0], one, torch.eye(4)[:1])
    with torch.no_grad():
        plugins.gaussian_codecs.load(codec)(plugins).encode(model, writer)
    return len(writer.to_bytes())
