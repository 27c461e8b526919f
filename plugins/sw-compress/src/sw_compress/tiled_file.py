"""Files of `gaussians-quantized` written and read tile by tile: each is a packet, coded like a file of its own.

Grid, steps, classes of precision and the basis of spherical harmonics are those of the whole scene, so that every
reader of such files takes them; one that stops at a packet has some places whole, and others not at all.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.rows import select

from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel
from splatwizard_core.tooling import filled_writer
from sw_codecs.models import precision, sh_basis
from sw_codecs.models.attributes import Ready, Values
from sw_codecs.models.band_context import suitable_classes
from sw_codecs.models.position_grid import PositionGrid
from sw_codecs.models.quantized import (
    BASIS,
    Lattice,
    Layout,
    Unrounded,
    decode_rows,
    encode_rows,
    finite,
    parsed,
    reconstruct,
    rounded,
)
from sw_compress.coders import Levels, Quantized

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Method, PluginManager
    from sw_codecs.models.settings import QuantizedSettings
    from sw_compress.large_scene import LargeScene


class _WholeBasis(sh_basis.Basis):
    """A basis of all tiles: whether it pays is decided for them together."""

    def pays(self, count: int, step: float) -> bool:
        return True


class TiledFile:
    """Writer of a file, with what all its tiles share.

    scene       what is written
    importance  what each of its Gaussians weighs in pictures [N]
    """

    def __init__(self, scene: LargeScene, importance: Tensor, coder: Quantized, own_basis: bool) -> None:
        self.scene, self.importance, self.coder, self.classes = scene, importance, coder, None
        if coder.power:
            self.classes = precision.classes_of(importance.cpu().double().numpy(), coder.power)
        self.grid = PositionGrid.fit(scene.light.means.detach().cpu().numpy(), 1)
        self.basis = self._basis() if own_basis and scene.degree else None

    def write(self, levels: Levels, path: Path) -> int:
        """Write the file; return its bytes."""
        method = _ByTiles(self.coder.method_of(levels), self, self.coder.settings(levels))
        origin = self.coder.origin or self.scene.light.world_origin or (0.0, 0.0, 0.0)
        writer, _ = filled_writer(method, self.scene.light, dict(self.coder.raster), origin)  # type: ignore[arg-type]
        return writer.write(path)

    def fill(self, writer: ContainerWriter, settings: QuantizedSettings, plugins: PluginManager) -> None:
        """Sections as of `gaussians-quantized` in packets."""
        positions = plugins.position_codecs.load(settings.positions)()
        columns = plugins.entropy_models.load(settings.entropy)()
        grid = replace(self.grid, bits=settings.position_bits)
        count, tiles = self.scene.num_rows, len(self.scene.tiles)
        layout, basis = None, self._paying(count, settings.rest_step)
        for tile in self.scene.tiles:
            found = rounded(self._unrounded(tile, basis), settings, positions.sort, grid)
            if layout is None:
                packets = [(end - start, 0.0) for start, end in itertools.pairwise(self.scene.limits)]
                layout = found.layout.model_copy(update={
                    "num_gaussians": count, "sh_classes": suitable_classes(count // tiles), "packets": packets,
                })  # fmt: skip
                writer.raster["sh_degree"] = layout.max_sh_degree
                writer.static.update(layout.model_dump(mode="json", exclude_none=True))
                settings.state(writer)
                if basis is not None:
                    writer.add(BASIS, basis.matrix.tobytes())
            encode_rows(replace(found, layout=layout), f"{tile + 1}/", writer, positions, columns)
            writer.cut()
        assert layout is not None  # a scene has a tile
        writer.allow(layout.decoded_bytes, f"a model of {count:,} Gaussians")

    def _unrounded(self, tile: int, basis: sh_basis.Basis | None) -> Unrounded:
        part, model = self.scene.rows(tile), self.scene.tile(tile)
        arrays = {name: getattr(model, name).detach().cpu().numpy() for name in model.RAW}
        classes = None if self.classes is None else self.classes[part]
        values = Values(
            dc=arrays["sh_dc"][:, 0], rest=arrays["sh_rest"], opacity_logits=arrays["opacity_logits"],
            log_scales=arrays["log_scales"], quats=arrays["quats"],
        )  # fmt: skip
        factors = np.ones(model.num_rows) if classes is None else precision.factors(classes)
        degree = self.scene.degree
        return Unrounded(degree, degree, None, arrays["means"], self.grid, Ready(values, factors, basis), classes)

    def _paying(self, count: int, step: float) -> sh_basis.Basis | None:
        """The basis where it saves more than it takes."""
        known = self.basis
        return _WholeBasis(known.matrix, known.variances) if known is not None and known.pays(count, step) else None

    def _basis(self) -> sh_basis.Basis:
        stride, found, count = sh_basis.stride(self.scene.num_rows), 0.0, 0
        for tile in self.scene.tiles:
            rest = self.scene.rest(tile)[::stride].flatten(1).double().cpu().numpy()
            if self.classes is not None:
                rest /= precision.factors(self.classes[self.scene.rows(tile)][::stride])[:, None]
            found, count = found + rest.T @ rest, count + len(rest)
        return sh_basis.of_covariance(np.asarray(found) / max(count, 1))


@dataclass(frozen=True)
class _ByTiles:
    """A method whose models are written tile by tile."""

    method: Method
    file: TiledFile
    settings: QuantizedSettings

    @property
    def name(self) -> str:
        return self.method.name

    @property
    def version(self) -> int:
        return self.method.version

    @property
    def plugins(self) -> PluginManager:
        return self.method.plugins

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        one = ContainerWriter(self.name, self.version)
        self.method.encode(select(model, torch.arange(1, device=model.device)), one)
        writer.static |= {key: value for key, value in one.static.items() if key not in Layout.model_fields}
        self.file.fill(writer, self.settings, self.plugins)


def tiles_of(reader: ContainerReader, plugins: PluginManager, device: torch.device) -> Iterator[GaussianModel]:
    """Decode a file of `TiledFile` tile by tile. Raises BitstreamError."""
    layout = parsed(reader, Layout)
    basis: NDArray[np.int8] | None = None
    if layout.sh_basis:
        with reader.decoding(BASIS) as data:
            basis = sh_basis.unpack(bytes(data), layout.rest_columns)
    for number, (rows, _) in enumerate(layout.packets or [], 1):
        part = layout.model_copy(update={"num_gaussians": rows})
        found = Lattice(
            part, np.empty((rows, 3), np.int64), np.empty((rows, layout.base_columns + layout.rest_columns), np.int32),
            basis, np.empty(rows, np.int32) if layout.precision else None,
        )  # fmt: skip
        decode_rows(found, f"{number}/", reader, plugins)
        model: Any = finite(reconstruct(found), reader)
        model.origin = {"raster": reader.raster}
        yield model.to(device).eval().requires_grad_(False)
    reader.finish()
