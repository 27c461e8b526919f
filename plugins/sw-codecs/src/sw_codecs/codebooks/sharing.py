"""Vectors that share codebook entries, except those whose change would show: these keep an entry of their own.

Source: "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis" (C3DGS, arXiv 2401.02436), section on
sensitivity-aware vector clustering.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from splatwizard_core.api import ShapeError
from sw_codecs.quantizers.vector_quantizer import VectorQuantizer

Training = Literal["batch-mean", "ema", "kmeans"]

COUNTED = 1 << 16  # vectors of which the distinct ones are counted: torch.unique takes a tensor for each of more


@dataclass(frozen=True)
class SharedVectors:
    """n vectors as indices into a codebook.

    index   [n] int64: entry of each vector
    entries [k, d]: first the shared ones, of which each stands for one vector at least, then the vectors of `own`
    own     [m] int64, ascending: the vectors with an entry of their own, the last m of `entries`
    """

    index: Tensor
    entries: Tensor
    own: Tensor


def share_vectors(
    x: Tensor,
    sensitivity: Tensor,
    *,
    threshold: float,
    size: int,
    generator: torch.Generator,
    training: Training = "batch-mean",
    iterations: int = 100,
    batch: int = 1 << 18,
    decay: float = 0.8,
    project: Callable[[Tensor], Tensor] | None = None,
    label: str = "codebook",
) -> SharedVectors:
    """Codebook of vectors [n, d] float, weighted by their sensitivity [n], which may hold -inf but no NaN.

    threshold   vectors of higher sensitivity keep an entry of their own
    size        entries at most that the others share; with no more distinct vectors than that (of up to 2^16 vectors in
                all), these are the entries
    training    "batch-mean" and "ema": that rule of `VectorQuantizer.train`, the first the published one, for
                `iterations` batches of `batch` vectors with `decay`; "kmeans": as many passes over all of them
    generator   seeds the codebook; on a CPU equal arguments give equal results
    project     codebook -> codebook after each batch; k-means gives means of vectors and needs none
    label       what the progress display calls it

    Entries that no vector uses are left out. Raises ShapeError for shapes that do not fit, ValueError for a NaN and for
    vectors that are not finite.
    """
    if x.ndim != 2 or sensitivity.shape != x.shape[:1]:
        raise ShapeError(f"vectors [n, d] and sensitivity [n], not {list(x.shape)} and {list(sensitivity.shape)}")
    if bool(torch.isnan(sensitivity).any()):
        raise ValueError("a sensitivity is not a number")
    x = x.detach()
    keeps = sensitivity > threshold
    own, others = keeps.nonzero().squeeze(1), (~keeps).nonzero().squeeze(1)
    shared, codes = x[:0], others
    if 0 < len(others) <= COUNTED:
        shared, codes = torch.unique(x[others], dim=0, return_inverse=True)
    if len(others) > COUNTED or len(shared) > size:
        rows, weights = x[others], sensitivity[others].double().clamp_min(0)
        used = weights if bool((weights > 0).any()) else None
        quantizer = VectorQuantizer(size, decay=decay)
        if training == "kmeans":
            quantizer.fit(rows, weights=used, iterations=iterations, generator=generator, label=label)
        else:
            quantizer.train(
                rows, used, iterations, batch, generator=generator, rule=training, project=project, label=label
            )
        assert quantizer.codebook is not None
        found, codes = torch.unique(quantizer.assign(rows), return_inverse=True)
        shared = quantizer.codebook[found]
    index = torch.empty(len(x), dtype=torch.int64, device=x.device)
    index[others] = codes
    index[own] = len(shared) + torch.arange(len(own), device=x.device)
    return SharedVectors(index, torch.cat([shared.to(x.dtype), x[own]]), own)
