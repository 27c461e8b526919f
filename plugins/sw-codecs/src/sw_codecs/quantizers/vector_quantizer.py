"""Quantizer `vq`: each row becomes its nearest codebook entry; k-means and EMA training in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError, ShapeError
from sw_codecs.codebooks.batches import RULES, smoothed, train_codebook
from sw_codecs.codebooks.kmeans import kmeans
from sw_codecs.codebooks.nearest import nearest
from sw_codecs.codebooks.stored import read_codebook, settled
from sw_codecs.codebooks.weighted_rows import draw, gather, training_rows
from sw_codecs.quantizers.side_information import within
from sw_codecs.quantizers.straight_through import straight_through


class VectorQuantizer:
    """x [N, d] -> index [N] of the nearest of `size` codebook entries, in squared Euclidean distance.

    size        codebook entries K
    decay       gamma of the EMA update, in 0..1
    commitment  beta of the commitment loss
    dead        entries whose EMA count falls below it are re-seeded from the data
    block       rows per tile of the search: it needs block * K floats, never N * K; None: what makes 64 MB on a CPU
    half        store the codebook as float16

    The codebook is made by `fit` (k-means, the better one) or `train` (weighted batches, as published methods do), or
    set. State: codebook [K, d], EMA counts [K] and sums [K, d], on the device of the data it was fitted to.
    Source: van den Oord et al. (arXiv 1711.00937) for the straight-through gradient, commitment and EMA.
    """

    def __init__(
        self,
        size: int = 8192,
        *,
        decay: float = 0.8,
        commitment: float = 0.25,
        dead: float = 1e-3,
        block: int | None = None,
        half: bool = False,
    ) -> None:
        if size < 1 or not 0 <= decay < 1 or (block is not None and block < 1):
            raise ValueError(f"size {size}, decay {decay}, block {block}: must be >= 1, in 0..1, >= 1")
        self.size, self.decay, self.commitment, self.dead, self.block, self.half = (
            size, decay, commitment, dead, block, half,
        )  # fmt: skip
        self.codebook: Tensor | None = None
        self.counts: Tensor | None = None
        self.sums: Tensor | None = None

    def fit(
        self,
        x: Tensor,
        *,
        generator: torch.Generator,
        weights: Tensor | None = None,
        iterations: int = 10,
        spread: bool = True,
        label: str = "codebook",
    ) -> Tensor:
        """k-means on x [N, d]; the weighted mean squared distance before the update of each iteration, [iterations].

        generator   seeds the start and where entries move; on CPU the result depends only on the arguments
        weights     [N] >= 0, importance of each row; None: all equal
        iterations  passes over x, of N * K distances each
        spread      start from rows far from each other; False: rows drawn by weight, without replacement
        label       what the progress display calls it

        With N < K the rows themselves become entries and the rest repeat the last one. Raises ShapeError for no rows,
        ValueError for values that are not finite.
        """
        x, weights = training_rows(x, weights)
        self.codebook, self.counts, self.sums, errors = kmeans(
            x, weights, size=self.size, iterations=iterations, generator=generator, spread=spread, block=self.block,
            label=label,
        )  # fmt: skip
        return errors

    def train(
        self,
        x: Tensor,
        weights: Tensor | None = None,
        iterations: int = 1000,
        batch: int = 80_000,
        *,
        generator: torch.Generator,
        rule: str = "ema",
        reseed: int = 10,
        start: Tensor | None = None,
        project: Callable[[Tensor], Tensor] | None = None,
        label: str = "codebook",
    ) -> Tensor:
        """Train on weighted batches of x [N, d]; the weighted error of each batch before its update, [iterations].

        weights     [N] >= 0, importance of each row; None: all equal
        batch       rows drawn with replacement for each iteration, at most N
        generator   seeds the start and the batches
        rule        "ema", "official" or "batch-mean": start and update, see sw_codecs.codebooks.batches
        reseed      entries at most that are overwritten after an iteration, those of the smallest counts, with rows of
                    the batch. "ema": only entries with less than 5 % of the mean count, with the rows of the largest
                    weighted error, and none in the last tenth (in the first half entries also move, unless it is 0);
                    "official": always, with the rows of the largest weights; "batch-mean": never
        start       [K, d], instead of the start of the rule
        project     codebook -> codebook, applied after each iteration (shapes with trace 1, say)
        label       what the progress display calls it

        An iteration costs batch * K distances. Source: LightGaussian (arXiv 2311.17245) for the loop. Raises as `fit`.
        """
        x, weights = training_rows(x, weights)
        if rule not in RULES:
            raise ValueError(f"rule '{rule}': must be one of {', '.join(RULES)}")
        if iterations < 0 or batch < 1 or reseed < 0:
            raise ValueError(f"iterations {iterations}, batch {batch}, reseed {reseed}: must be >= 0, >= 1, >= 0")
        if start is not None and start.shape != (self.size, x.shape[1]):
            raise ShapeError(f"start has shape {list(start.shape)}")
        self.codebook, self.counts, self.sums, errors = train_codebook(
            x, weights, size=self.size, rule=rule, iterations=iterations, batch=batch, decay=self.decay, reseed=reseed,
            generator=generator, start=start, project=project, block=self.block, label=label,
        )  # fmt: skip
        return errors

    @torch.no_grad()
    def update(self, x: Tensor, *, generator: torch.Generator, weights: Tensor | None = None) -> None:
        """One EMA step with x [N, d]: counts, sums and codebook move by 1 - decay towards this batch."""
        codebook = self._fitted().detach()
        if len(self._rows(x)) == 0:
            return
        weights = torch.ones(len(x), device=x.device) if weights is None else weights
        training_rows(x, weights)  # EMA counts need weights on one scale over all batches: checked, not rescaled
        x, weights = self._rows(x), weights.detach().to(x)
        index, _ = nearest(x, codebook.to(x.dtype), block=self.block)
        counts, sums = gather(x, weights, index, self.size)
        assert self.counts is not None
        assert self.sums is not None
        self.counts = self.decay * self.counts + (1 - self.decay) * counts
        self.sums = self.decay * self.sums + (1 - self.decay) * sums
        alive = self.counts >= self.dead
        codebook = torch.where(alive[:, None], self.sums / smoothed(self.counts)[:, None], codebook)
        lost = torch.nonzero(~alive).squeeze(1)
        if len(lost):
            fresh = draw(weights, min(len(lost), len(x)), generator)
            lost = lost[: len(fresh)]
            codebook[lost] = x[fresh].to(codebook.dtype)
            self.counts[lost], self.sums[lost] = 1.0, x[fresh].to(self.sums.dtype)
        self.codebook = codebook.to(x.dtype)

    def assign(self, x: Tensor) -> Tensor:
        """Index [N] int64 of the nearest entry."""
        rows = self._rows(x)
        return nearest(rows, self._fitted().detach().to(rows.dtype), block=self.block)[0]

    def forward(self, x: Tensor) -> Tensor:
        """The nearest entries [N, d]; the gradient passes straight through to x."""
        return straight_through(x, self._fitted()[self.assign(x)])

    __call__ = forward

    def commitment_loss(self, x: Tensor) -> Tensor:
        """beta * mean squared distance of x to its (constant) entries; a scalar. It moves x."""
        return self.commitment * (x - self._fitted()[self.assign(x)].detach()).square().mean()

    def codebook_loss(self, x: Tensor) -> Tensor:
        """Mean squared distance of (constant) x to its entries; a scalar. It moves a codebook that requires grad."""
        return (x.detach() - self._fitted()[self.assign(x)]).square().mean()

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Indices [N] int64, and {"codebook"} [K, d] float32 (float16 with `half`) as a numpy array.

        Searches in the codebook as it is stored, so that `decode` gives the nearest stored entry. Raises ValueError for
        values that are not finite.
        """
        rows = self._rows(x).to(torch.float32)
        if not bool(torch.isfinite(rows).all()):
            raise ValueError("values to quantize must be finite")
        codebook = self._fitted().detach().to(torch.float16 if self.half else torch.float32)
        if not bool(torch.isfinite(codebook).all()):
            raise ValueError("the codebook holds values that are not finite in its stored precision")
        entries = codebook.to(torch.float32)
        index, _ = nearest(rows, entries, block=self.block)
        return settled(index, entries, block=self.block), {"codebook": codebook.cpu().numpy()}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """[N, d] float32. Raises BitstreamError for an index outside the codebook."""
        codebook = read_codebook(side, "codebook", 2)
        if symbols.ndim != 1:
            raise BitstreamError(f"codebook indices have shape {list(symbols.shape)}, must be [N]")
        return torch.from_numpy(codebook).to(symbols.device)[within(symbols, 0, len(codebook) - 1)]

    def _fitted(self) -> Tensor:
        if self.codebook is None:
            raise RuntimeError("the vector quantizer has no codebook yet: call fit first")
        return self.codebook

    def _rows(self, x: Tensor) -> Tensor:
        width = None if self.codebook is None else self.codebook.shape[1]
        if x.ndim != 2 or (width is not None and x.shape[1] != width):
            raise ShapeError(f"rows have shape {list(x.shape)}")
        return x.detach() if x.dtype == torch.float64 else x.detach().to(torch.float32)
