"""Quantizer `residual-vq`: a sum of codebook entries, each stage coding what the stages before it left over."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatwizard_core.api import BitstreamError, ShapeError
from sw_codecs.codebooks.kmeans import kmeans
from sw_codecs.codebooks.nearest import nearest
from sw_codecs.codebooks.stored import read_codebook
from sw_codecs.codebooks.weighted_rows import training_rows
from sw_codecs.quantizers.side_information import finite_values, within
from sw_codecs.quantizers.straight_through import straight_through


class ResidualVectorQuantizer(nn.Module):
    """r_0 = x [N, d]; j_s = the entry of stage s nearest to r_s; r_(s+1) = r_s - c_(s, j_s); x^ = the sum of entries.

    size     entries K of each stage
    stages   S
    dim      d; None: known from the first `fit` (or the first state that is loaded)
    block    rows per tile of the search; None: what makes 64 MB on a CPU
    half     store the codebooks as float16

    `fit` makes the codebooks by k-means, stage after stage; `codebook_loss` trains them further with any optimizer.
    The search is greedy: encoding a decoded row again need not find the symbols that it was made of (their sum may lie
    nearer to another entry of the first stage), but `decode` of what `encode` gave is `forward`, to the bit.
    State (in state_dict): codebooks [S, K, d]. Source: SoundStream (arXiv 2107.03312); 6 stages of 64 entries, trained
    so, in Compact 3D Gaussian Representation (arXiv 2311.13681).
    """

    codebooks: nn.Parameter | None

    def __init__(
        self, size: int = 64, stages: int = 6, *, dim: int | None = None, block: int | None = None, half: bool = False
    ) -> None:
        super().__init__()
        if size < 1 or stages < 1 or (block is not None and block < 1):
            raise ValueError(f"size {size}, stages {stages}, block {block}: must be >= 1")
        self.size, self.stages, self.block, self.is_half = size, stages, block, half
        self.codebooks = None if dim is None else nn.Parameter(torch.zeros(stages, size, dim))

    def fit(
        self,
        x: Tensor,
        *,
        generator: torch.Generator,
        weights: Tensor | None = None,
        iterations: int = 10,
        spread: bool = True,
    ) -> Tensor:
        """k-means on what each stage has to code; the mean squared distance that each leaves, [S].

        weights      [N] >= 0, importance of each row; None: all equal
        iterations   passes over x for each stage; from 1 on no stage leaves more than it was given
        spread       start from rows far from each other; False: rows drawn by weight
        """
        residual, importance = training_rows(x, weights)
        residual = residual.to(torch.float32)
        importance = importance.to(torch.float32)
        books, errors = [], []
        for stage in range(self.stages):
            book, *_ = kmeans(
                residual, importance, size=self.size, iterations=iterations, generator=generator, spread=spread,
                block=self.block, label=f"codebook {stage + 1} of {self.stages}",
            )  # fmt: skip
            index, distance = nearest(residual, book, block=self.block)
            residual = residual - book[index]
            books.append(book)
            errors.append((distance * importance).mean())
        self._hold(torch.stack(books))
        return torch.stack(errors)

    @torch.no_grad()
    def assign(self, x: Tensor) -> Tensor:
        """Symbols [N, S] int64: the entry of each stage."""
        return self._search(x, self._fitted().detach())[0]

    def forward(self, x: Tensor) -> Tensor:
        """x^ [N, d]; the gradient passes straight through to x, once."""
        books = self._fitted().detach()
        return straight_through(x, self._search(x, books)[1])

    def codebook_loss(self, x: Tensor) -> Tensor:
        """Sum over the stages of the mean squared distance of residuals to entries; it moves the codebooks only."""
        return self.forward_with_loss(x)[1]

    def forward_with_loss(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`forward` and `codebook_loss` of x by one search."""
        books = self._fitted()
        symbols, found = self._search(x, books.detach())
        residual, loss = x.detach().to(books.dtype), books.new_zeros(())
        for entries in _entries(books, symbols):
            loss = loss + (residual - entries).square().mean()
            residual = residual - entries.detach()
        return straight_through(x, found), loss

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Symbols [N, S] int64, and {"codebooks"} [S, K, d] float32 (float16 with `half`) as a numpy array.

        Searches in the codebooks as they are stored. Raises ValueError for values that are not finite.
        """
        if not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        books = self._fitted().detach().to(torch.float16 if self.is_half else torch.float32)
        if not bool(torch.isfinite(books).all()):
            raise ValueError("the codebook holds values that are not finite in its stored precision")
        return self._search(x, books.to(torch.float32))[0], {"codebooks": books.cpu().numpy()}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ [N, d] float32. Raises BitstreamError if the side information does not fit."""
        books = torch.from_numpy(read_codebook(side, "codebooks", 3)).to(symbols.device)
        if symbols.ndim != 2 or symbols.shape[1] != len(books) or len(books) == 0:
            raise BitstreamError(f"codebook indices have shape {list(symbols.shape)}, must be [N, {len(books)}]")
        index = within(symbols, 0, books.shape[1] - 1)
        return finite_values(_sum(books, index))

    @torch.no_grad()
    def _search(self, x: Tensor, books: Tensor) -> tuple[Tensor, Tensor]:
        """Symbols [N, S], and the sum of their entries [N, d]."""
        if x.ndim != 2 or x.shape[1] != books.shape[2]:
            raise ShapeError(f"rows have shape {list(x.shape)}")
        residual = x.detach().to(books.dtype)
        found = []
        for book in books:
            found.append(nearest(residual, book, block=self.block)[0])
            residual = residual - book[found[-1]]
        symbols = torch.stack(found, 1)
        return symbols, _sum(books, symbols)

    def _fitted(self) -> nn.Parameter:
        if self.codebooks is None:
            raise RuntimeError("the vector quantizer has no codebook yet: call fit first")
        return self.codebooks

    def _hold(self, books: Tensor) -> None:
        if self.codebooks is None or self.codebooks.shape != books.shape:
            self.codebooks = nn.Parameter(books.clone())
        else:  # an optimizer may hold the parameter
            self.codebooks.data = books.clone()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        if self.codebooks is None and prefix + "codebooks" in state_dict:
            self.codebooks = nn.Parameter(torch.empty_like(state_dict[prefix + "codebooks"]))
        super()._load_from_state_dict(state_dict, prefix, *args)


def _entries(books: Tensor, symbols: Tensor) -> tuple[Tensor, ...]:
    """The entries [N, d] of each of S stages, differentiable: one sum for the gradients of all stages.

    On the CPU the gradient of an index is summed by several threads in any order; that of `index_select` is not, nor
    on CUDA where algorithms must be deterministic, but there one entry after the other: `embedding` sorts them.
    """
    stages, size, dim = books.shape
    rows = symbols + size * torch.arange(stages, device=symbols.device)
    if books.is_cuda and torch.are_deterministic_algorithms_enabled():
        return functional.embedding(rows, books.view(-1, dim)).unbind(1)
    return books.view(-1, dim).index_select(0, rows.view(-1)).view(-1, stages, dim).unbind(1)


def _sum(books: Tensor, symbols: Tensor) -> Tensor:
    """The entries of each row added in the order of the stages, [N, d]."""
    total = books[0][symbols[:, 0]]
    for stage in range(1, len(books)):
        total = total + books[stage][symbols[:, stage]]
    return total
