"""File sections of anchor attributes: quantised integers, coded in blocks under the rate model's distributions.

A method writes one loop over the blocks, which predicts each block from those before it. The loop passes predictions to
an `AttributeEncoder`, which rounds and codes a model's values, or to an `AttributeDecoder`, which reads the file. Both
return the integers, so encoder and decoder make the same predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError
from sw_anchors.fast import exact_lattice
from sw_anchors.row_parts import MAX_EXACT_NUMBERS, parts_of
from sw_anchors.shape import GROUPS, AnchorShape
from sw_codecs.context.integer_mlp import FRACTION, IntegerMlp
from sw_codecs.entropy.exact_tables import step_multipliers
from sw_codecs.entropy.rows import RowContext, RowLattice
from sw_codecs.quantizers.multiples import symbols_of

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_anchors.coded_anchors import CodedAnchors
    from sw_anchors.decoded_anchors import DecodedAnchors
    from sw_codecs.entropy.conditional import ConditionalGaussian


Coders = Mapping[type, Any]
"""Type of distributions -> the entropy model that takes it, with `encode` and `decode`."""


class Block(NamedTuple):
    """Rows and columns of an attribute group that are coded in one call."""

    section: str
    group: str
    rows: slice
    columns: slice = slice(None)


class AttributeCoder:
    """Common interface of AttributeEncoder and AttributeDecoder.

    rows        the blocks of rows that a walk goes over, in order
    """

    def __init__(
        self, count: int, shape: AnchorShape, mode: str, plugins: PluginManager, further: Coders | None = None
    ) -> None:
        """Set up for `count` anchors; mode "exact" or "float" of the entropy model `conditional-gaussian`.

        further     entropy models for distributions of other types
        """
        self.coder: ConditionalGaussian = plugins.entropy_models.load("conditional-gaussian")(mode)
        self.further = further or {}
        self.rows = self.coder.blocks(count, max(shape.widths))

    def code(self, block: Block, distributions: Any, step: Tensor, present: Tensor | None = None) -> Tensor:
        """Code one block; return its integers [n,C] int64, 0 where they are not in the file.

        distributions   of its numbers in the units of the mode: RowContext, RowLattice, or a `further` one
        step            [n,1] float64, quantiser steps in units of the values
        present         [n,C] bool: numbers that are in the file; None: all
        """
        raise NotImplementedError


class AttributeEncoder(AttributeCoder):
    """Rounds the attributes of a model's anchors `rows` [N] (their order in the file) and codes them."""

    def __init__(
        self,
        model: CodedAnchors,
        rows: Tensor,
        sections: Sequence[str],
        mode: str,
        plugins: PluginManager,
        further: Coders | None = None,
    ) -> None:
        super().__init__(len(rows), model.shape, mode, plugins, further)
        self._values = dict(zip(GROUPS, (v.detach().cpu() for v in model.raw(rows)), strict=True))
        self._centres = dict(zip(GROUPS, (c.cpu() for c in model.centres()), strict=True))
        self._coded: dict[str, list[bytes]] = {name: [] for name in sections}

    def code(self, block: Block, distributions: Any, step: Tensor, present: Tensor | None = None) -> Tensor:
        values = self._values[block.group][block.rows, block.columns].double()
        symbols = symbols_of(values, step, self._centres[block.group])
        symbols = symbols if present is None else symbols * present
        coder = self.further.get(type(distributions), self.coder)
        self._coded[block.section].append(coder.encode(symbols.numpy(), distributions, present))
        return symbols

    def write(self, writer: ContainerWriter) -> None:
        """Add all sections to the file, after the last block."""
        for name, blocks in self._coded.items():
            writer.add(name, self.coder.join(blocks))


class AttributeDecoder(AttributeCoder):
    """Reads an AttributeEncoder's sections into a DecodedAnchors; errors name the section."""

    def __init__(
        self,
        reader: ContainerReader,
        model: DecodedAnchors,
        sections: Sequence[str],
        mode: str,
        plugins: PluginManager,
        further: Coders | None = None,
    ) -> None:
        """Raises BitstreamError if a section is missing."""
        shape = AnchorShape(model.features.shape[1], model.num_offsets)
        super().__init__(model.num_rows, shape, mode, plugins, further)
        self._reader = reader
        found = (model.features.data, model.scales.data, model.offsets.data.view(-1, shape.widths[2]))
        self._found = dict(zip(GROUPS, found, strict=True))
        self._coded: dict[str, Iterator[bytes]] = {
            name: self.coder.split(reader.section(name), len(self.rows)) for name in sections
        }

    def code(self, block: Block, distributions: Any, step: Tensor, present: Tensor | None = None) -> Tensor:
        """Raises BitstreamError for damage."""
        with self._reader.decoding(block.section):
            data = next(self._coded[block.section])
            values = self._found[block.group][block.rows, block.columns]
            if type(distributions) not in self.further:
                return self.coder.decode_into(values, data, distributions, step, present)
            symbols = torch.from_numpy(self.further[type(distributions)].decode(data, distributions, present))
            values.copy_(symbols * step)
        return symbols

    def finish(self) -> None:
        """Raise BitstreamError if bytes follow the last block of a section, or a value is not finite."""
        for name, blocks in self._coded.items():
            with self._reader.decoding(name):
                next(blocks, None)
        if self.coder.mode == "exact":
            return  # integers below 2^30 times steps below 2^32: no float32 overflows
        for group, values in self._found.items():
            if not bool(torch.isfinite(values).all()):
                raise BitstreamError(
                    f"{self._reader.name}: decoded {group} are not finite: the file is damaged or hostile"
                )


class ExactNetwork:
    """A context network evaluated in integers (`integer-mlp`), the same on every machine.

    Means and scales come in base steps with 12 fractional bits, steps as multiples of the base in 1/4096.
    """

    def __init__(
        self,
        network: nn.Sequential,
        shape: AnchorShape,
        base_steps: Sequence[float],
        *,
        step_offset: int = 0,
        further: int = 0,
    ) -> None:
        """Convert weights, already rounded as in the file, to integers.

        step_offset added to round(4096 (1 + tanh t)) of a step logit t
        further     outputs that follow those of the shape, in units of 1

        Raises ValueError if the network cannot be evaluated exactly.
        """
        units = [1 / base for base, width in zip(base_steps, shape.widths, strict=True) for _ in range(2 * width)]
        self.network = IntegerMlp.from_module(
            network, output_scale=np.array([*units, *[1.0] * (len(GROUPS) + further)])
        )
        self.shape, self._base_steps, self.step_offset = shape, tuple(base_steps), step_offset

    def on_lattice(
        self, places: Tensor, features: Callable[[Tensor], Tensor], width: int
    ) -> Mapping[str, RowContext | RowLattice]:
        """Return distributions as a call does, in coder (lattice) form directly if there is a kernel."""
        return exact_lattice.on_lattice(self, places, features, width) or self(places, features, width)

    def __call__(self, places: Tensor, features: Callable[[Tensor], Tensor], width: int) -> dict[str, RowContext]:
        """Return distributions per group for anchors at `places` [n, ...].

        features    places of some rows -> int64 [rows, inputs] with 12 fractional bits; each row on its own
        width       the most numbers that a row has while they are looked up
        """
        return self.read(self.outputs(places, features, width))

    def outputs(self, places: Tensor, features: Callable[[Tensor], Tensor], width: int) -> Tensor:
        """Return network outputs, int64 [n, sum(shape.outputs) + further]; arguments as in a call."""
        outputs = torch.empty(len(places), self.network.outputs, dtype=torch.int64)
        start = 0
        for part in parts_of(places, width, MAX_EXACT_NUMBERS):
            self.network(features(part), out=outputs[start : start + len(part)])
            start += len(part)
        return outputs

    def read(self, outputs: Tensor) -> dict[str, RowContext]:
        """Convert outputs [n, sum(shape.outputs)] to distributions per group."""
        parts = torch.split(outputs, self.shape.outputs, dim=1)
        multipliers = torch.from_numpy(step_multipliers(parts[6].numpy()) + self.step_offset)
        return {
            group: RowContext(parts[2 * i], parts[2 * i + 1], multipliers[:, i : i + 1])
            for i, group in enumerate(GROUPS)
        }

    def steps(self, group: str, distributions: RowContext | RowLattice) -> Tensor:
        """Return quantiser steps [n,1] float64 of a group, in units of the values."""
        multipliers = torch.as_tensor(distributions.step)
        return multipliers.to(torch.float64) * (self._base_steps[GROUPS.index(group)] / (1 << FRACTION))
