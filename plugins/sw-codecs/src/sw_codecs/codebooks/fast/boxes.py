"""Nearest codebook entries by boxes about groups of entries, on a CPU.

A native kernel leaves out the groups whose box is farther than an entry that was found. Where the entries have few axes
or vary along few (shapes, trained colours), that is nearly all of them. Plain form: `nearest.search_by_products`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from splatwizard_native import fast_enabled
from sw_codecs.fast import kernel_operations
from sw_codecs.native import CODECS

WORTH_BOXES = 1 << 22
"""Distances; some 10 ms of matrix products."""
SAMPLE = 512
"""Rows that tell whether boxes leave out enough."""
SHARE = 0.5
"""Most of the distances that may be left; each costs about as much as one of a matrix product."""


def fits(x: Tensor, entries: Tensor) -> bool:
    """Whether there is a kernel for rows x [N, d] and entries [K, d], and enough of them; loads it."""
    on_cpu = x.device.type == "cpu" and x.dtype == entries.dtype == torch.float32 and entries.shape[1] > 0
    return fast_enabled() and on_cpu and len(x) * len(entries) >= WORTH_BOXES and CODECS.try_load()


def search_by_boxes(x: Tensor, entries: Tensor) -> Callable[[Tensor, int], Tensor] | None:
    """Return the search of the native kernel, see `nearest.Search`.

    None where a sample of x shows that boxes leave out too little.
    """
    centre = entries.mean(0)
    centred = entries - centre
    # Along the axes of the entries' variance, the largest first, boxes about the first few leave out most.
    squares = centred.double().T @ centred.double()
    if not bool(torch.isfinite(squares).all()):
        return None
    axes = torch.linalg.eigh(squares).eigenvectors.flip(1).to(x.dtype)
    turned = (centred @ axes).contiguous()

    def look(rows: Tensor) -> tuple[Tensor, float]:
        return kernel_operations.nearest_entries((rows - centre) @ axes, turned)

    if look(x[:: max(len(x) // SAMPLE, 1)])[1] > SHARE:
        return None
    return lambda rows, _start: look(rows)[0]
