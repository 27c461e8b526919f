"""Quantizer `ecvq`: the entry that is near and cheap to code, by squared distance plus a weight times its bits."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError, ShapeError, track
from sw_codecs.kmeans import kmeans
from sw_codecs.nearest import nearest
from sw_codecs.side_information import within
from sw_codecs.stored_codebook import read_codebook
from sw_codecs.straight_through import straight_through
from sw_codecs.weighted_rows import gather, training_rows


class EntropyConstrainedQuantizer(nn.Module):
    """x [N, d] -> j = argmin |x - c_j|^2 + rate_weight * b_j with b_j = -log2 softmax(logits)_j bits; x^ = c_j.

    size          entries K
    rate_weight   lambda >= 0, squared units of x per bit. The distance is squared and summed over the d values; where
                  others take the distance itself, or divide by their lambda, their numbers do not carry over
    dim           d; None: known from the first `fit` (or the first state that is loaded)
    block         rows per tile of the search; None: what makes 64 MB on a CPU
    half          store the codebook as float16

    `fit` alternates assignment, means and frequencies; `loss` trains codebook and logits with any optimizer.
    A rare entry costs bits, so a decoded row, encoded again, may go to a cheaper entry beside it; `decode` of what
    `encode` gave is `forward`, to the bit. State (in state_dict): codebook [K, d], logits [K].
    Source: Chou, Lookabaugh and Gray, "Entropy-constrained vector quantization" (IEEE Trans. ASSP 37, 1989).
    """

    codebook: nn.Parameter | None

    def __init__(
        self,
        size: int = 256,
        *,
        rate_weight: float = 0.01,
        dim: int | None = None,
        block: int | None = None,
        half: bool = False,
    ) -> None:
        super().__init__()
        if size < 1 or not 0 <= rate_weight < math.inf or (block is not None and block < 1):
            raise ValueError(f"size {size}, rate_weight {rate_weight}, block {block}: must be >= 1, >= 0, >= 1")
        self.size, self.rate_weight, self.block, self.is_half = size, rate_weight, block, half
        self.codebook = None if dim is None else nn.Parameter(torch.zeros(size, dim))
        self.logits = nn.Parameter(torch.zeros(size))

    def fit(
        self, x: Tensor, *, generator: torch.Generator, weights: Tensor | None = None, iterations: int = 10
    ) -> Tensor:
        """k-means, then ECVQ iterations, as many of each; the objective before each of the latter, [iterations].

        weights   [N] >= 0, importance of each row in the distance and in the frequencies; None: all equal

        The objective, the weighted mean of |x - c|^2 + rate_weight * bits, never rises, up to rounding and the half row
        that keeps an unused entry's bits finite.
        """
        x, weights = training_rows(x, weights)
        x, weights = x.to(torch.float32), weights.to(torch.float32)
        entries, counts, *_ = kmeans(
            x, weights, size=self.size, iterations=iterations, generator=generator, block=self.block
        )
        objective = x.new_zeros(iterations)
        with track("rates", total=iterations) as bar:
            for i in range(iterations):
                bits = -torch.log2(_frequencies(counts)).to(torch.float32)
                index, distance = nearest(x, entries, bias=self.rate_weight * bits, block=self.block)
                objective[i] = ((distance + self.rate_weight * bits[index]) * weights).mean()
                counts, sums = gather(x, weights, index, self.size)
                entries = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1e-300)[:, None], entries).to(x)
                bar.advance(1, objective=objective[i])
        if self.codebook is None or self.codebook.shape != entries.shape:
            self.codebook = nn.Parameter(entries)
        self.codebook.data, self.logits.data = entries, torch.log(_frequencies(counts)).to(x)
        return objective

    def bits(self) -> Tensor:
        """Bits of each entry, [K]; differentiable in the logits."""
        return -torch.log_softmax(self.logits, 0) / math.log(2)

    def assign(self, x: Tensor) -> Tensor:
        """Index [N] int64 of the entry with the least squared distance plus rate."""
        return self._search(x, self._fitted().detach())

    def forward(self, x: Tensor) -> Tensor:
        """The entries [N, d]; the gradient passes straight through to x."""
        return straight_through(x, self._fitted()[self.assign(x)])

    def rate(self, x: Tensor) -> Tensor:
        """Bits of each row, [N]; differentiable in the logits."""
        return self.bits()[self.assign(x)]

    def loss(self, x: Tensor) -> Tensor:
        """Mean of |x - c|^2 + rate_weight * bits over the rows, a scalar; it moves codebook and logits, not x."""
        index = self.assign(x)
        distance = (x.detach() - self._fitted()[index]).square().sum(1)
        return (distance + self.rate_weight * self.bits()[index]).mean()

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Index [N] int64, and {"codebook"} [K, d] float32 (float16 with `half`) as a numpy array.

        Searches in the codebook as it is stored. Raises ValueError for values that are not finite.
        """
        if not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        codebook = self._fitted().detach().to(torch.float16 if self.is_half else torch.float32)
        if not bool(torch.isfinite(codebook).all() and torch.isfinite(self.logits).all()):
            raise ValueError("the codebook holds values that are not finite in its stored precision")
        return self._search(x, codebook.to(torch.float32)), {"codebook": codebook.cpu().numpy()}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """[N, d] float32. Raises BitstreamError if the side information does not fit."""
        codebook = torch.from_numpy(read_codebook(side, "codebook", 2)).to(symbols.device)
        if symbols.ndim != 1:
            raise BitstreamError(f"codebook indices have shape {list(symbols.shape)}, must be [N]")
        return codebook[within(symbols, 0, len(codebook) - 1)]

    @torch.no_grad()
    def _search(self, x: Tensor, entries: Tensor) -> Tensor:
        if x.ndim != 2 or x.shape[1] != entries.shape[1]:
            raise ShapeError(f"rows have shape {list(x.shape)}", actual=x.shape, expected=("N", entries.shape[1]))
        return nearest(x.detach().to(entries.dtype), entries, bias=self.rate_weight * self.bits(), block=self.block)[0]

    def _fitted(self) -> nn.Parameter:
        if self.codebook is None:
            raise RuntimeError("the vector quantizer has no codebook yet: call fit first")
        return self.codebook

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        if self.codebook is None and prefix + "codebook" in state_dict:
            self.codebook = nn.Parameter(torch.empty_like(state_dict[prefix + "codebook"]))
        super()._load_from_state_dict(state_dict, prefix, *args)


def _frequencies(counts: Tensor) -> Tensor:
    """Share of each entry, none 0: half a row more for each."""
    return (counts + 0.5) / (counts + 0.5).sum()
