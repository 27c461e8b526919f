"""The parts of a codec that another package may provide, by name: an entropy model of integers, a position codec.

A codec asks for them by the names in its settings, so a file's requirements list them; a header names what is not the
usual one. Each is tried on a few numbers before anything is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field, model_serializer

from splatwizard_core.api import BitstreamError, ConfigError, Params, PluginError
from sw_codecs.positions import morton

if TYPE_CHECKING:
    from splatwizard_core.api import (
        ArrayCoder,
        ContainerReader,
        ContainerWriter,
        EntropyModel,
        PluginManager,
        PositionCodec,
    )


class NamedParts(Params):
    """Settings of a codec with such parts. Usual ones are left out of what is kept: older files and runs have none.

    USUAL   setting -> name of the part where nothing else is asked for
    """

    USUAL: ClassVar[dict[str, str]] = {}

    @model_serializer(mode="wrap")
    def _without_usual(self, plain: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        return {key: value for key, value in plain(self).items() if self.USUAL.get(key, ...) != value}

    def named(self) -> dict[str, str]:
        """Return the parts that are not the usual ones."""
        given = {part: getattr(self, part) for part in self.USUAL}
        return {part: name for part, name in given.items() if name != self.USUAL[part]}

    def state(self, writer: ContainerWriter) -> None:
        """Write the names of parts that are not the usual ones into the header."""
        writer.static.update(self.named())


class Exchangeable(NamedParts):
    """Settings of a codec of integers and positions."""

    USUAL: ClassVar[dict[str, str]] = {"entropy": "columns", "positions": "octree"}

    entropy: str = Field("columns", description="entropy model of all but positions: any that codes integer matrices")
    positions: str = Field("octree", description="coder of the positions: any that codes positions")

    def check(self, plugins: PluginManager) -> None:
        """Raise ConfigError for a part that is not installed, or does not do what the codec needs of it."""
        held: dict[str, tuple[Any, Callable[[Any], str]]] = {
            "entropy": (plugins.entropy_models, codes_matrices),
            "positions": (plugins.position_codecs, _codes_positions),
        }  # fmt: skip
        for part, name in self.named().items():
            known, tried = held[part]
            hold_part(known, name, f"codec.settings.{part}", tried)


def hold_part(known: Any, name: str, key: str, tried: Callable[[Any], str]) -> None:
    """Raise ConfigError for a part that is not installed, or of which `tried` returns a fault.

    known   a registry, or the coders of one sort
    key     of the config where the name stands
    """
    try:
        entry = known.entry(name)
        fault = tried(entry.load()())
    except PluginError as error:
        raise ConfigError(f"{key}: {error}", key=key) from error
    except Exception as error:
        fault = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if fault:
        raise ConfigError(f"{entry.whose} cannot serve as {key}: {fault}", key=key)


def entropy_model(reader: ContainerReader, plugins: PluginManager) -> EntropyModel:
    """Return the entropy model that a header names. Raises PluginError for one that is not installed."""
    name = "columns"
    if "entropy" in reader.static:
        name = reader.text("entropy", choices=plugins.entropy_models.names)
    return plugins.entropy_models.load(name)()


def position_codec(reader: ContainerReader, plugins: PluginManager, max_points: int) -> PositionCodec:
    """Return the position codec that a header names. Raises PluginError for one that is not installed."""
    name = "octree"
    if "positions" in reader.static:
        name = reader.text("positions", choices=plugins.position_codecs.names)
    return plugins.position_codecs.load(name)(max_points=max_points)


def array_coder(reader: ContainerReader, plugins: PluginManager, part: str, usual: str) -> ArrayCoder:
    """Return the array coder that a header names as `part`, else the usual one. Raises PluginError."""
    name = reader.text(part, choices=plugins.array_coders.names) if part in reader.static else usual
    return plugins.array_coders.load(name)()


def decoded_matrix(model: EntropyModel, data: bytes, *shape: int) -> np.ndarray:
    """Return symbols of a shape that an entropy model decodes. Raises BitstreamError for anything else."""
    found = np.asarray(model.decode(data, shape))
    if found.shape != shape or not np.issubdtype(found.dtype, np.integer):
        raise BitstreamError(f"the entropy model gives {found.dtype} {list(found.shape)} for integers {list(shape)}")
    return found


def codes_matrices(model: EntropyModel) -> str:
    """Return what an entropy model does wrong with integers, matrices and rows of them; "" for nothing."""
    for symbols in (np.array([[0, -3], [7, 1 << 20], [0, 5]], np.int32), np.arange(4), np.zeros((0, 2), np.int32)):
        found = decoded_matrix(model, model.encode(symbols, None), *symbols.shape)
        if not np.array_equal(found, symbols):
            return f"it decodes {symbols.tolist()} as {found.tolist()}"
    return ""


def _codes_positions(codec: PositionCodec) -> str:
    points = np.array([[5, 1, 2], [0, 0, 0], [5, 1, 2], [7, 7, 7]])
    ordered = points[codec.sort(points)]
    if np.any(np.diff(morton.encode(ordered)) < 0):
        return "it does not sort in Morton order"
    found = codec.decode(codec.encode(ordered, 3))
    return "" if np.array_equal(found, ordered) else f"it decodes {ordered.tolist()} as {found.tolist()}"


def codes_arrays(coder: ArrayCoder, dtypes: Sequence[type] = (np.float16, np.uint8, np.uint16, np.uint32)) -> str:
    """Return what an array coder does wrong with arrays of these types; "" for nothing."""
    for dtype in dtypes:
        is_float = np.issubdtype(dtype, np.floating)
        array = ((np.arange(6) - 2.5) / 3 if is_float else np.arange(6)).reshape(2, 3).astype(dtype)
        if not np.array_equal(coder.decode(coder.encode(array), dtype, array.shape), array):
            return f"another array comes back of {np.dtype(dtype)}"
    return ""
