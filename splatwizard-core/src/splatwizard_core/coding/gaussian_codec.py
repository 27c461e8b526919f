"""Write and read explicit Gaussians with a codec of whole models, chosen by name (contracts.GaussianCodec)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.errors import ConfigError
from splatwizard_core.gaussians.model import GaussianModel

if TYPE_CHECKING:
    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.plugins import PluginManager

KEY = "codec"
"""Header value that names the codec."""


def check_gaussian_codec(plugins: PluginManager, name: str, key: str = KEY) -> None:
    """Raise ConfigError if none of that name is installed: a method asks in `stages`, before anything is trained.

    key     of the method's config that names it
    """
    known = plugins.gaussian_codecs.names
    if name not in known:
        raise ConfigError(f"no codec for Gaussians is called '{name}'; installed: {', '.join(known)}", key=key)


def encode_gaussians(
    plugins: PluginManager, name: str, model: SplatModel, writer: ContainerWriter, **settings: Any
) -> None:
    """Write `model` with the codec `name`, whose name goes into the header.

    Raises TypeError if the model is no GaussianModel, ConfigError if there is no codec of that name, PluginError if it
    cannot be loaded.
    """
    if not isinstance(model, GaussianModel):
        raise TypeError(f"{writer.method} encodes a GaussianModel, not a {type(model).__name__}")
    check_gaussian_codec(plugins, name)
    writer.static[KEY] = name
    plugins.gaussian_codecs.load(name)(plugins, **settings).encode(model, writer)


def decode_gaussians(plugins: PluginManager, reader: ContainerReader) -> GaussianModel:
    """The model that `encode_gaussians` wrote. Raises BitstreamError."""
    name = reader.text(KEY, choices=plugins.gaussian_codecs.names)
    return plugins.gaussian_codecs.load(name)(plugins).decode(reader)
