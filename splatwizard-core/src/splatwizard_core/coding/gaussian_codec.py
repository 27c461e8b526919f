"""Whole-model codecs for explicit Gaussians, shared by name: a method that only prunes needs no file format of its own.

A plugin registers one with `register_coders`, declared `codes="gaussians"`; the target is a class

    Codec(plugins, **settings)      every setting has a default
        .encode(model, writer)      writes sections and header values of a GaussianModel
        .decode(reader)             the model; raises BitstreamError

Header values of a codec lie in `writer.static`; a method that borrows one keeps its own under `static["method"]`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from splatwizard_core.errors import ConfigError
from splatwizard_core.gaussians.model import GaussianModel

if TYPE_CHECKING:
    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.plugins import PluginManager

KEY = "codec"
"""Header value that names the codec."""

BORROWED = (KEY, "method")
"""Header values that a codec finds beside its own."""


class GaussianCodec(Protocol):
    """Turns a GaussianModel into sections of a file and back."""

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write everything that `decode` needs; leaves the model as it is."""
        ...

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """The inverse. Raises BitstreamError."""
        ...


def gaussian_codecs(plugins: PluginManager) -> list[str]:
    """Names of the installed ones."""
    return [entry.name for entry in plugins.coders if entry.declared.get("codes") == "gaussians"]


def check_gaussian_codec(plugins: PluginManager, name: str, key: str = KEY) -> None:
    """Raise ConfigError if none of that name is installed: a method asks in `stages`, before anything is trained.

    key     of the method's config that names it
    """
    known = gaussian_codecs(plugins)
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
    plugins.coders.load(name)(plugins, **settings).encode(model, writer)


def decode_gaussians(plugins: PluginManager, reader: ContainerReader) -> GaussianModel:
    """What `encode_gaussians` wrote. Raises BitstreamError."""
    name = reader.text(KEY, choices=gaussian_codecs(plugins))
    model: GaussianModel = plugins.coders.load(name)(plugins).decode(reader)
    return model
