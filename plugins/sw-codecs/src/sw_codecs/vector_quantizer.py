"""Quantizer `vq`: each row becomes its nearest codebook entry; k-means and EMA training in bounded memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.errors import BitstreamError, ShapeError

EPSILON = 1e-5  # Laplace smoothing of the EMA counts


class VectorQuantizer:
    """x [N, d] -> index [N] of the nearest of `size` codebook entries, in squared Euclidean distance.

    size        codebook entries K
    decay       gamma of the EMA update, in 0..1
    commitment  beta of the commitment loss
    dead        entries whose EMA count falls below it are re-seeded from the data
    block       rows per block of the search: it needs block * K floats, never N * K
    half        store the codebook as float16

    State: codebook [K, d], EMA counts [K] and sums [K, d], on the device of the data it was fitted to.
    Source: specification of the codec library, quantisers (VQ).
    """

    def __init__(
        self,
        size: int = 8192,
        *,
        decay: float = 0.8,
        commitment: float = 0.25,
        dead: float = 1e-3,
        block: int = 1 << 14,
        half: bool = False,
    ) -> None:
        if size < 1 or not 0 <= decay < 1 or block < 1:
            raise ValueError(f"size {size}, decay {decay}, block {block}: must be >= 1, in 0..1, >= 1")
        self.size, self.decay, self.commitment, self.dead, self.block, self.half = (
            size, decay, commitment, dead, block, half,
        )  # fmt: skip
        self.codebook: Tensor | None = None
        self.counts: Tensor | None = None
        self.sums: Tensor | None = None

    def fit(
        self, x: Tensor, *, generator: torch.Generator, weights: Tensor | None = None, iterations: int = 10
    ) -> Tensor:
        """k-means on x [N, d]; the mean squared distance after each iteration, [iterations].

        generator   seeds the start (rows drawn by weight, without replacement) and the re-seeding of empty entries
        weights     [N] >= 0, importance of each row; None: all equal

        With N < K the rows themselves become entries and the rest repeat the last one. On CPU the result depends only
        on the arguments.
        """
        x, weights = self._rows(x), self._weights(x, weights)
        if len(x) == 0:
            raise ShapeError("a codebook cannot be fitted to no rows", actual=x.shape, expected=("N", "d"))
        chosen = self._draw(weights, min(self.size, len(x)), generator)
        self.codebook = x[chosen]
        if len(chosen) < self.size:
            self.codebook = torch.cat([self.codebook, self.codebook[-1:].expand(self.size - len(chosen), -1)])
        errors = []
        for _ in range(iterations):
            index, distance = self._search(x)
            counts, sums = self._gather(x, weights, index)
            used = counts > 0
            means = sums / torch.where(used, counts, 1.0)[:, None]
            self.codebook = torch.where(used[:, None], means, self.codebook).to(x.dtype)
            errors.append((distance * weights).sum() / weights.sum())
            empty = torch.nonzero(~used).squeeze(1)
            if len(empty) and len(x) > self.size:
                # An empty entry goes where the error is: rows drawn by their weighted distance.
                fresh = self._draw((distance * weights).clamp_min(0), len(empty), generator)
                self.codebook[empty[: len(fresh)]] = x[fresh]
        index, _ = self._search(x)
        self.counts, self.sums = self._gather(x, weights, index)
        return torch.stack(errors) if errors else x.new_zeros(0)

    @torch.no_grad()
    def update(self, x: Tensor, *, generator: torch.Generator, weights: Tensor | None = None) -> None:
        """One EMA step with x [N, d]: counts, sums and codebook move by 1 - decay towards this batch."""
        x, weights = self._rows(x), self._weights(x, weights)
        codebook = self._fitted()
        if len(x) == 0:
            return
        index, _ = self._search(x)
        counts, sums = self._gather(x, weights, index)
        assert self.counts is not None
        assert self.sums is not None
        self.counts = self.decay * self.counts + (1 - self.decay) * counts
        self.sums = self.decay * self.sums + (1 - self.decay) * sums
        total = self.counts.sum()
        smooth = (self.counts + EPSILON) / (total + self.size * EPSILON) * total
        alive = self.counts >= self.dead
        codebook = torch.where(alive[:, None], self.sums / smooth.clamp_min(1e-30)[:, None], codebook)
        lost = torch.nonzero(~alive).squeeze(1)
        if len(lost):
            fresh = self._draw(weights, min(len(lost), len(x)), generator)
            lost = lost[: len(fresh)]
            codebook[lost] = x[fresh].to(codebook.dtype)
            self.counts[lost], self.sums[lost] = 1.0, x[fresh].to(self.sums.dtype)
        self.codebook = codebook.to(x.dtype)

    def assign(self, x: Tensor) -> Tensor:
        """Index [N] int64 of the nearest entry, the first one if several are equally near."""
        return self._search(self._rows(x))[0]

    def forward(self, x: Tensor) -> Tensor:
        """The nearest entries [N, d]; the gradient passes straight through to x."""
        nearest = self._fitted()[self.assign(x)].to(x.dtype)
        return x + (nearest - x).detach()

    __call__ = forward

    def commitment_loss(self, x: Tensor) -> Tensor:
        """beta * mean squared distance of x to its (constant) entries; a scalar."""
        return self.commitment * (x - self._fitted()[self.assign(x)].detach()).square().mean()

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Indices [N] int64, and {"codebook"} [K, d] float32 (float16 with `half`) as a numpy array.

        Searches in the codebook as it is stored, so that `decode` gives the nearest stored entry. Raises ValueError for
        values that are not finite.
        """
        if not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        codebook = self._fitted().detach().to(torch.float16 if self.half else torch.float32)
        if not bool(torch.isfinite(codebook).all()):
            raise ValueError("the codebook holds values that are not finite in its stored precision")
        index, _ = self._search(self._rows(x), codebook.to(torch.float32))
        return index, {"codebook": codebook.cpu().numpy()}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """[N, d] float32. Raises BitstreamError for an index outside the codebook."""
        codebook = np.asarray(side.get("codebook"))
        if codebook.ndim != 2 or codebook.dtype.kind != "f" or not np.isfinite(codebook).all():
            raise BitstreamError("a codebook is missing, has a wrong shape or is not finite")
        if symbols.numel() and not 0 <= int(symbols.min()) <= int(symbols.max()) < len(codebook):
            raise BitstreamError(f"a codebook index is outside 0..{len(codebook) - 1}")
        return torch.from_numpy(codebook.astype(np.float32)).to(symbols.device)[symbols.to(torch.int64)]

    def _fitted(self) -> Tensor:
        if self.codebook is None:
            raise RuntimeError("the vector quantizer has no codebook yet: call fit first")
        return self.codebook

    def _rows(self, x: Tensor) -> Tensor:
        width = None if self.codebook is None else self.codebook.shape[1]
        if x.ndim != 2 or (width is not None and x.shape[1] != width):
            raise ShapeError(f"rows have shape {list(x.shape)}", actual=x.shape, expected=("N", width or "d"))
        return x.detach()

    def _weights(self, x: Tensor, weights: Tensor | None) -> Tensor:
        if weights is None:
            return torch.ones(len(x), dtype=x.dtype, device=x.device)
        if weights.shape != x.shape[:1] or bool((weights < 0).any()) or (len(x) and not float(weights.sum()) > 0):
            raise ValueError("weights must be one number >= 0 per row, not all zero")
        return weights.detach().to(x.dtype)

    @torch.no_grad()
    def _search(self, x: Tensor, codebook: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Nearest entry [N] int64 and its squared distance [N], `block` rows at a time."""
        entries = (self._fitted() if codebook is None else codebook).to(x.dtype)
        norms = entries.square().sum(1)
        index = torch.empty(len(x), dtype=torch.int64, device=x.device)
        distance = torch.empty(len(x), dtype=x.dtype, device=x.device)
        for start in range(0, len(x), self.block):
            rows = x[start : start + self.block]
            found = torch.addmm(norms, rows, entries.T, alpha=-2).argmin(1)  # |c|^2 - 2 x.c: |x|^2 changes no order
            index[start : start + self.block] = found
            distance[start : start + self.block] = (rows - entries[found]).square().sum(1)
        return index, distance

    def _gather(self, x: Tensor, weights: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted counts [K] and sums [K, d] of the rows of each entry, float64."""
        counts = torch.zeros(self.size, dtype=torch.float64, device=x.device)
        sums = torch.zeros(self.size, x.shape[1], dtype=torch.float64, device=x.device)
        for start in range(0, len(x), self.block):
            part = slice(start, start + self.block)
            weight = weights[part].to(torch.float64)
            counts.index_add_(0, index[part], weight)
            sums.index_add_(0, index[part], x[part].to(torch.float64) * weight[:, None])
        return counts, sums

    @staticmethod
    def _draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """`count` distinct rows (fewer if fewer have weight), by weight: the largest of u^(1/w). Any N, no limit."""
        u = torch.rand(len(weights), generator=generator, device=generator.device, dtype=torch.float64)
        keys = torch.log(u.clamp_min(1e-300)).to(weights.device) / weights.to(torch.float64)  # w = 0: -inf
        return torch.topk(keys, min(count, int((weights > 0).sum()))).indices
