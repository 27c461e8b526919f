"""The files of 3DGS as codecs that any method of explicit Gaussians may ask for by name (`GaussianMethod`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sw_codecs.models import exact, lossless, ply_section, quantized
from sw_codecs.models.settings import QuantizedSettings

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel, PluginManager


class Exact:
    """float32 as trained, 236 bytes per Gaussian at SH degree 3."""

    def __init__(self, plugins: PluginManager) -> None:
        pass

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        exact.encode(model, writer)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return exact.decode(reader)


class Quantized:
    """Octree positions, all else on a lattice and range coded (defaults: rate r5 of 3dgs)."""

    Settings = QuantizedSettings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.plugins, self.settings = plugins, QuantizedSettings(**settings)
        self.settings.check(plugins)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        quantized.encode(model, writer, self.settings, self.plugins)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return quantized.decode(reader, self.plugins)


class Ply:
    """The .ply of 3DGS as it is, 248 bytes per Gaussian at SH degree 3: the size that pruning papers report."""

    def __init__(self, plugins: PluginManager) -> None:
        pass

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        ply_section.encode(model, writer)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return ply_section.decode(reader)


class Lossless:
    """float32 as trained, in spatial order, byte planes and zstd: every bit comes back."""

    Settings = lossless.LosslessSettings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.plugins, self.settings = plugins, lossless.LosslessSettings(**settings)
        self.settings.check(plugins)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        lossless.encode(model, writer, self.plugins, self.settings)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return lossless.decode(reader, self.plugins)
