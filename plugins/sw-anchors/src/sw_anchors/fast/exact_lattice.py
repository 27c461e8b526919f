"""Exact context network and coder lattice in one kernel, without intermediate means and scales."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from splatwizard_native import fast_enabled
from sw_anchors.row_parts import MAX_EXACT_NUMBERS, parts_of
from sw_anchors.shape import GROUPS, AnchorShape
from sw_codecs.context.integer_mlp import IntegerMlp, for_kernel
from sw_codecs.entropy.exact_tables import exact_tables
from sw_codecs.entropy.rows import RowLattice
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations


class Network(Protocol):
    """Protocol of the ExactNetwork members read here."""

    network: IntegerMlp
    shape: AnchorShape
    step_offset: int


def on_lattice(
    of: Network, places: Tensor, features: Callable[[Tensor], Tensor], width: int
) -> dict[str, RowLattice] | None:
    """Return what `ExactNetwork.__call__` returns, as a RowLattice each; None without a kernel, or out of range."""
    if not fast_enabled() or not EXACT.try_load():
        return None
    n, columns = len(places), of.shape.widths
    centre = [torch.empty(n, c, dtype=torch.int32) for c in columns]
    number = [torch.empty(n, c, dtype=torch.int16) for c in columns]
    steps = torch.empty(n, len(columns), dtype=torch.int64)
    multipliers = torch.from_numpy(exact_tables().multipliers + of.step_offset)
    thresholds, start = torch.from_numpy(exact_tables().thresholds), 0
    layers = of.network.flat(), of.network.widths
    for part in parts_of(places, width, MAX_EXACT_NUMBERS) if n else ():
        at = slice(start, start + len(part))
        into = [c[at] for c in centre], [c[at] for c in number], steps[at]
        if exact_operations.forecast([for_kernel(features(part))], *layers, multipliers, thresholds, *into):
            return None  # out of range: whoever codes the numbers says so
        start += len(part)
    return {group: RowLattice(centre[i], number[i], steps[:, i : i + 1]) for i, group in enumerate(GROUPS)}
