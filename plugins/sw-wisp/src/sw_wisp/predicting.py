"""Context `pyramid`: four small networks predict each number from the running means of the splats before it.

A splat's features (`sw_wisp.pyramid`) go to network A for opacity, B for shape and size, C for colour, D for latents,
together with the splat's numbers that are known by then. Each gives for its columns what to add to the running mean,
the scale level, and a step output t for each of its step groups. All of it in integers of `integer-mlp`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.context.integer_mlp import IntegerMlp
from sw_codecs.entropy.exact_tables import exact_tables, step_multipliers
from sw_wisp.eight_bits import EXACT_EXPONENT, EightBitLayer, pack_layers, unpack_layers
from sw_wisp.fast.forecasts import forecasts
from sw_wisp.fast.running_means import pyramid_of
from sw_wisp.nested import UNIT
from sw_wisp.numbers import BLOCKS, LATENTS, NUMBERS
from sw_wisp.packets import Prediction, State
from sw_wisp.pyramid import BASE, FEATURES, VIEW, WAVES, Pyramid
from sw_wisp.static import MEAN_UNIT
from sw_wisp.ties import moved, pack_ties, tied_parts, unpack_ties

HIDDEN = {"large": (32, 48, 32, 40), "small": (16, 24, 16, 20)}
"""Hidden numbers of the networks, by their size."""
STEPS_OF = ([0], [0] * 5 + [1], [0] * 3, [0] * 12)
"""Which step output of its network each column has: shape and size differ, the others share one."""
ADAPTIVE, SMALL = 1, 2  # flags of the file


def network_shapes(size: str) -> list[tuple[int, int, int]]:
    """Inputs, hidden numbers and outputs of each network."""
    return [
        (FEATURES + block.start, hidden, 2 * (block.stop - block.start) + max(steps) + 1)
        for block, hidden, steps in zip(BLOCKS, HIDDEN[size], STEPS_OF, strict=True)
    ]


@dataclass
class PyramidContext:
    """Contents of the file.

    prior       [22] int64, multiples of 16: means where nothing is known, base steps with 12 fractional bits
    layers      two of each network, exponents at least -12
    ties        what known numbers of a block say of those behind, the same
    adaptive    whether steps follow the networks; else base steps
    """

    prior: np.ndarray
    layers: tuple[EightBitLayer, ...]
    ties: tuple[EightBitLayer, ...]
    adaptive: bool = True
    _networks: list[IntegerMlp] = field(init=False, repr=False)
    _pyramid: Pyramid = field(init=False, repr=False)
    _features: torch.Tensor = field(init=False, repr=False)

    kind = "pyramid"
    waves = WAVES

    def __post_init__(self) -> None:
        pairs = [[layer.floats() for layer in self.layers[i : i + 2]] for i in range(0, len(self.layers), 2)]
        self._networks = [IntegerMlp(pair) for pair in pairs]
        self.start()

    def start(self) -> None:
        """Forget all splats."""
        self._pyramid = pyramid_of(torch.from_numpy(self.prior))

    def predict(self, block: slice, rows: np.ndarray, state: State) -> Prediction:
        """Distributions of the columns `block` of splats `rows`, all blocks before it known."""
        known = len(self._pyramid)
        if known < len(state.levels):
            self._pyramid.announce(*(torch.from_numpy(each[known:]) for each in (state.levels, state.cells.codes)))
        number, width = BLOCKS.index(block), block.stop - block.start
        if number == 0 or block == VIEW:
            self._features = self._pyramid.features(torch.from_numpy(rows))  # B and C follow A with the same rows
        further = torch.from_numpy(state.units(rows, slice(0, block.start))) if number else None
        out = self._networks[number](self._features, further)
        table = exact_tables().multipliers if self.adaptive else None
        found = forecasts(self._features, out, block.start, STEPS_OF[number], table)
        if found is not None:
            return Prediction(*found)
        given = out.numpy()
        mean = self._features[:, block].numpy() + given[:, :width]
        multiplier = np.full(mean.shape, UNIT)
        if self.adaptive:
            multiplier = step_multipliers(given[:, 2 * width :])[:, STEPS_OF[number]]
        return Prediction(mean, given[:, width : 2 * width], multiplier)

    def moved(self, part: slice, rows: np.ndarray, state: State) -> np.ndarray | None:
        """Additions [2,n,c] to the means and scales of a part, for those before it in its block."""
        for tie, (tied, before) in zip(self.ties, tied_parts(), strict=True):
            if tied == part:
                return moved(tie, before, rows, state)
        return None

    def changed(self, rows: np.ndarray, columns: slice, before: np.ndarray | None, state: State) -> None:
        """Take splats that became known, or finer, into the running means."""
        at, units = torch.from_numpy(rows), torch.from_numpy(state.units(rows, columns))
        if before is not None:
            self._pyramid.refine(at, columns, torch.from_numpy(before), units)
        else:
            part = VIEW if columns == LATENTS.columns else BASE
            self._pyramid.add(at, part, units, torch.from_numpy(state.index[rows, columns].astype(np.int64)))

    def pack(self) -> bytes:
        """Flags, prior, layers, ties."""
        is_small = len(self.layers[0].weights) == HIDDEN["small"][0]
        return (
            bytes([ADAPTIVE * self.adaptive | SMALL * is_small])
            + (self.prior // MEAN_UNIT).astype("<i2").tobytes()
            + pack_layers(self.layers)
            + pack_ties(self.ties)
        )

    @classmethod
    def unpack(cls, reader: ByteReader) -> PyramidContext:
        """Inverse of `pack`. Raises BitstreamError."""
        flags = reader.integer(1)
        if flags > ADAPTIVE + SMALL:
            raise BitstreamError(f"the context has flags {flags}, which are not known")
        prior = np.frombuffer(reader.take(2 * NUMBERS), "<i2").astype(np.int64) * MEAN_UNIT
        sizes = network_shapes("small" if flags & SMALL else "large")
        shapes = [shape for i, h, o in sizes for shape in ((h, i, 1), (o, h, 1))]
        layers, ties = unpack_layers(reader, shapes), unpack_ties(reader)
        if min(int(layer.exponents.min()) for layer in layers) < EXACT_EXPONENT:
            raise BitstreamError("a weight of the context is finer than its integers")
        try:
            return cls(prior, layers, ties, flags & ADAPTIVE > 0)
        except ValueError as error:
            raise BitstreamError(f"the context networks cannot be used: {error}") from error
