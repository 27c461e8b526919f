"""Front-to-back compositing over per-tile lists, vectorised over (tiles x pixels x splats) and bounded in memory.

Lists only have to hold every splat that may pass the alpha cut somewhere in the tile: each pixel decides for itself,
so the result does not depend on the size of the tiles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sw_reference.projection import CLASSIC_TILE, Projection

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
T_MIN = 1e-4
CHUNK_ELEMENTS = 1 << 18
"""(pixel, splat) pairs evaluated at once: 1 MB a float32 temporary, which stays in a CPU core's cache."""
CHUNK_SPLATS = 128
KEEP_ELEMENTS = 1 << 23
"""Above this many pairs the backward pass evaluates each chunk again instead of keeping its temporaries."""


@dataclass
class TileLists:
    """Splats of each tile, front to back.

    tile     pixels a side
    grid     (columns, rows)
    splats   [P] int64 depth ranks, tile after tile
    starts, counts   [tiles] int64
    """

    tile: int
    grid: tuple[int, int]
    splats: Tensor
    starts: Tensor
    counts: Tensor


@torch.no_grad()
def tile_lists(rect: Tensor, width: int, height: int, tile: int) -> TileLists:
    """Lists of depth ranks. Raises RuntimeError beyond 2^31 pairs.

    rect    [V,4] int64 tiles x0, y0, x1, y1 of each splat, x0 <= x < x1, in depth order
    """
    columns, rows = -(-width // tile), -(-height // tile)
    x0, y0, x1, y1 = rect.unbind(1)
    across = x1 - x0
    sizes = across * (y1 - y0)
    total = int(sizes.sum())
    if total >= 2**31:
        raise RuntimeError(
            f"{total} (Gaussian, tile) pairs in one view; the limit is 2^31: the scales are far too large"
        )
    ranks = torch.repeat_interleave(torch.arange(len(rect), device=rect.device), sizes)
    within = torch.arange(total, device=rect.device) - (torch.cumsum(sizes, 0) - sizes)[ranks]
    tiles = (y0[ranks] + within // across[ranks]) * columns + x0[ranks] + within % across[ranks]
    tiles, by_tile = torch.sort(tiles, stable=True)
    counts = torch.bincount(tiles, minlength=columns * rows)
    return TileLists(tile, (columns, rows), ranks[by_tile], torch.cumsum(counts, 0) - counts, counts)


@torch.no_grad()
def support_rectangles(p: Projection, width: int, height: int, tile: int, *, classic: bool) -> Tensor:
    """[V,4] tiles that hold a pixel centre inside the box around sigma <= ln(255 opacity); empty where faint.

    classic  the square 3-sigma rectangle of the original instead
    """
    if classic:
        assert tile == CLASSIC_TILE
        return p.rect
    level = log_cutoff(p.opacity)
    extent = torch.sqrt(level.clamp(min=0)[:, None] * p.cov2d[:, [0, 2]])
    u = p.u.detach()
    return box_rectangles(u - extent, u + extent, level >= 0, width, height, tile)


def log_cutoff(opacity: Tensor) -> Tensor:
    """2 ln(255 opacity): the squared distance in standard deviations at which alpha falls to 1/255; no gradient."""
    return 2 * torch.log(opacity.detach() / ALPHA_MIN)


def box_rectangles(low: Tensor, high: Tensor, drawn: Tensor, width: int, height: int, tile: int) -> Tensor:
    """[V,4] tiles that hold a pixel centre in the boxes low..high [V,2]; empty where not `drawn` [V]."""
    limit = low.new_tensor([-(-width // tile), -(-height // tile)])
    slack = (high - low) * 0.0005 + 0.01  # rounding must not lose a pixel; each pixel tests exactly
    first = torch.floor((low - 0.5 - slack) / tile).clamp(min=0)
    last = torch.minimum(torch.floor((high - 0.5 + slack) / tile) + 1, limit)
    last = torch.where(drawn[:, None], torch.maximum(first, last), first)
    return torch.cat([torch.minimum(first, limit), torch.minimum(last, limit)], dim=1).long()


@dataclass
class Splats:
    """The splats to composite, in depth order: one row of `packed` a splat, so that a chunk is one gather.

    packed      [V, 8 + D]: u (2), conic (3), opacity, absgrad probe (2, zeros), channels (D)
    detached    the last so many channels do not influence the geometry
    depth       [V] for the median, or None
    pass_clamp  let the gradient through the clamp of alpha, as the original does
    absgrad     the gradient of the probe is the sum over pixels of |dL/du|
    """

    packed: Tensor
    num_channels: int
    detached: int = 0
    depth: Tensor | None = None
    pass_clamp: bool = False
    absgrad: bool = False


@dataclass
class Terms:
    """One chunk of evaluated pairs, each [B tiles, P pixels, L splats] unless said otherwise.

    weight = alpha T, zero where not blended; `before` is T in front of the splat; `alive` is False from the
    splat on that triggers the stop; `T` [B,P] after the chunk; `done` [B,P] finished pixels
    """

    dx: Tensor
    dy: Tensor
    alpha: Tensor
    before: Tensor
    weight: Tensor
    alive: Tensor
    clamped: Tensor
    channels: Tensor  # [B,L,D]
    opacity: Tensor  # [B,1,L]
    T: Tensor
    done: Tensor
    was_done: Tensor  # [B,P] before the chunk


class _Offsets(torch.autograd.Function):
    """d = u - pixel centre, and a probe whose gradient is the sum over pixels of |dL/du|."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, probe: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
        d = u[:, None] - centres[:, :, None]  # [B,P,L,2]
        return d[..., 0].contiguous(), d[..., 1].contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, Tensor, None]:
        gx, gy = grads
        total = torch.stack([gx.sum(dim=1), gy.sum(dim=1)], dim=-1)
        absolute = torch.stack([gx.abs().sum(dim=1), gy.abs().sum(dim=1)], dim=-1)
        return total, absolute, None


def evaluate(
    splats: Splats, packed: Tensor, ids: Tensor, valid: Tensor, centres: Tensor, T: Tensor, done: Tensor
) -> Terms:
    """Alpha, transmittance and the three cuts for the splats ids [B,L] (where `valid`) at `centres` [B,P,2]."""
    rows = packed.index_select(0, ids.reshape(-1)).reshape(*ids.shape, packed.shape[1])  # [B,L,8+D]
    ka, kb, kc, opacity = (rows[:, None, :, i] for i in range(2, 6))
    if splats.absgrad:
        dx, dy = _Offsets.apply(rows[..., 0:2], rows[..., 6:8], centres)  # type: ignore[no-untyped-call]
    else:
        dx = rows[:, None, :, 0] - centres[:, :, None, 0]
        dy = rows[:, None, :, 1] - centres[:, :, None, 1]
    sigma = 0.5 * (ka * dx * dx + kc * dy * dy) + kb * dx * dy  # [B,P,L]
    raw = opacity * torch.exp(-sigma.clamp(min=0))  # the clamp only keeps skipped pairs from overflowing
    alpha = raw.clamp(max=ALPHA_MAX)
    if splats.pass_clamp:
        alpha = raw + (alpha - raw).detach()
    tried = valid[:, None] & (sigma >= 0) & (alpha >= ALPHA_MIN)
    alpha = torch.where(tried, alpha, 0)
    passed, alive, weight, T_after, done_after = transmit(alpha, T, done)
    return Terms(
        dx, dy, alpha, passed[..., :-1], weight, alive, raw > ALPHA_MAX, rows[..., 8:], opacity,
        T_after, done_after, done,
    )  # fmt: skip


def transmit(alpha: Tensor, T: Tensor, done: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Light through a chunk, front to back: alpha [B,P,L] (0 where skipped), T and done [B,P] in front of it.

    Returns T before each splat and after the last one [B,P,L+1], alive and weight [B,P,L], T and done [B,P] behind it.
    """
    # A skipped pair multiplies T by exactly 1, so the first product below the limit is the splat that stops the
    # pixel, and all after it are below as well: the comparison latches by itself.
    after = T[..., None] * torch.cumprod(1 - alpha, dim=-1)
    passed = torch.cat([T[..., None], after], dim=-1)  # [B,P,L+1]
    alive = (after >= T_MIN) & ~done[..., None]
    weight = torch.where(alive, alpha * passed[..., :-1], 0)
    T_after = passed.gather(-1, alive.sum(dim=-1, keepdim=True)).squeeze(-1)
    return passed, alive, weight, T_after, done | ~alive.all(dim=-1)


def last_above_half(blended: Tensor, before: Tensor) -> Tensor:
    """[B,P] 1-based position of the last blended splat that more than half the light reaches; 0: none."""
    at = torch.arange(1, before.shape[-1] + 1, device=before.device)
    return torch.where(blended & (before > 0.5), at, 0).amax(dim=-1)


@dataclass
class Batch:
    """Tiles of similar list length that are drawn together."""

    tiles: Tensor  # [B]
    starts: Tensor  # [B]
    counts: Tensor  # [B]
    longest: int
    pixels: Tensor  # [B,P,2] int64, column and row
    centres: Tensor  # [B,P,2]
    outside: Tensor  # [B,P] bool, pixels beyond the image


def batches(lists: TileLists, width: int, height: int, dtype: torch.dtype) -> Iterator[Batch]:
    """Every tile that has a splat; if none has, the first one alone (results stay connected to their inputs)."""
    pixels = lists.tile**2
    order = torch.argsort(lists.counts, descending=True, stable=True)
    order = order[: max(1, int((lists.counts > 0).sum()))]
    lengths = lists.counts[order].tolist()
    device = order.device
    ys, xs = torch.meshgrid(*[torch.arange(lists.tile, device=device)] * 2, indexing="ij")
    local = torch.stack([xs, ys], dim=-1).reshape(-1, 2)
    size = torch.tensor([width, height], device=device)
    start = 0
    while start < len(lengths):
        step = max(1, CHUNK_ELEMENTS // (pixels * max(1, min(lengths[start], CHUNK_SPLATS))))
        tiles = order[start : start + step]
        corner = torch.stack([tiles % lists.grid[0], tiles // lists.grid[0]], dim=-1) * lists.tile
        at = corner[:, None] + local  # [B,P,2]
        yield Batch(
            tiles, lists.starts[tiles], lists.counts[tiles], lengths[start], at, at.to(dtype) + 0.5,
            (at >= size).any(dim=-1),
        )  # fmt: skip
        start += step


def chunks(batch: Batch, lists: TileLists) -> Iterator[tuple[Tensor, Tensor]]:
    """(ids [B,L], valid [B,L]) front to back; at least one chunk."""
    for first in range(0, max(1, batch.longest), CHUNK_SPLATS):
        at = torch.arange(first, min(first + CHUNK_SPLATS, batch.longest), device=batch.tiles.device)
        valid = at < batch.counts[:, None]
        where = torch.where(valid, batch.starts[:, None] + at, 0)
        yield lists.splats[where], valid


@torch.no_grad()
def evaluated(splats: Splats, lists: TileLists, batch: Batch) -> Iterator[tuple[Tensor, Terms]]:
    """(ids, terms) of every chunk of one batch front to back, until its pixels are finished; no gradient."""
    T, done = splats.packed.new_ones(batch.outside.shape), batch.outside
    for ids, valid in chunks(batch, lists):
        terms = evaluate(splats, splats.packed, ids, valid, batch.centres, T, done)
        yield ids, terms
        T, done = terms.T, terms.done
        if bool(done.all()):
            return


State = tuple[Tensor | None, ...]
"""Sums of a pixel, each [B,P] or [B,P,D]; all zero in front of the first splat."""
Blend = Callable[..., tuple[Tensor, ...]]
"""(packed, ids, valid, centres, T, done, *state) -> (T, done, number of blended pairs, *state): one chunk."""


@dataclass
class Drawn:
    """Per pixel: T [H,W] and the final state, each [D,H,W] (None where it was None); counters of pairs."""

    T: Tensor
    state: list[Tensor | None]
    n_evaluated: int
    n_blended: int


def draw_batches(
    blend: Blend, widths: list[int | None], packed: Tensor, lists: TileLists, width: int, height: int
) -> Drawn:
    """Run `blend` over the chunks of every tile, front to back.

    widths   per entry of the state its number of channels, 0 for a plain [B,P], None for an entry that is not kept
    """
    pixels = lists.tile**2
    recompute = torch.is_grad_enabled() and int(lists.counts.sum()) * pixels > KEEP_ELEMENTS
    parts: list[tuple[Tensor, State]] = []
    tiles: list[Tensor] = []
    n_evaluated, n_blended = 0, 0
    for batch in batches(lists, width, height, packed.dtype):
        T = packed.new_ones(batch.outside.shape)
        state: State = tuple(
            None if n is None else packed.new_zeros(*T.shape, *([n] if n else [])) for n in widths
        )  # fmt: skip
        done = batch.outside
        for ids, valid in chunks(batch, lists):
            arguments = (packed, ids, valid, batch.centres, T, done, *state)
            if recompute:
                T, done, blended, *rest = checkpoint(blend, *arguments, use_reentrant=False, preserve_rng_state=False)
            else:
                T, done, blended, *rest = blend(*arguments)
            state = tuple(rest)
            n_evaluated += int(valid.sum()) * pixels
            n_blended += int(blended)
            if bool(done.all()):
                break
        parts.append((T, state))
        tiles.append(batch.tiles)

    where = torch.cat(tiles)

    def assemble(drawn: list[Tensor], empty: float) -> Tensor:
        """Tiles [.,P] or [.,P,D] -> [1 or D,H,W]; tiles without a splat hold `empty`."""
        values = torch.cat(drawn)
        columns, rows = lists.grid
        full = values.new_full((columns * rows, *values.shape[1:]), empty).index_copy(0, where, values)
        full = full.reshape(rows, columns, lists.tile, lists.tile, *(values.shape[2:] or (1,)))
        image = full.permute(4, 0, 2, 1, 3).flatten(3, 4).flatten(1, 2)
        return image[:, :height, :width]

    finished: list[Tensor | None] = [
        None if n is None else assemble([x for _, state in parts if (x := state[i]) is not None], 0.0)
        for i, n in enumerate(widths)
    ]
    return Drawn(assemble([T for T, _ in parts], 1.0)[0], finished, n_evaluated, n_blended)


@dataclass
class Composite:
    """Pixels: channels [D,H,W] without background, T [H,W], median depth [H,W] or None; counters of pairs."""

    channels: Tensor
    T: Tensor
    median: Tensor | None
    n_evaluated: int = 0
    n_blended: int = 0


def composite(splats: Splats, lists: TileLists, width: int, height: int) -> Composite:
    """Blend every tile; differentiable in `splats.packed` and `splats.depth`."""
    attached = splats.num_channels - splats.detached

    def blend(
        packed: Tensor, ids: Tensor, valid: Tensor, centres: Tensor, T: Tensor, done: Tensor,
        total: Tensor, median: Tensor | None,
    ) -> tuple[Any, ...]:  # fmt: skip
        terms = evaluate(splats, packed, ids, valid, centres, T, done)
        sums = [torch.bmm(terms.weight, terms.channels[..., :attached])]
        if splats.detached:
            sums.append(torch.bmm(terms.weight.detach(), terms.channels[..., attached:]))
        blended = terms.weight > 0
        if splats.depth is not None and ids.shape[1]:
            assert median is not None
            last = last_above_half(blended, terms.before)
            z = splats.depth[ids].gather(1, (last - 1).clamp(min=0))
            median = torch.where(last > 0, z, median)
        return terms.T, terms.done, blended.sum(), total + torch.cat(sums, dim=-1), median

    widths = [splats.num_channels, None if splats.depth is None else 0]
    drawn = draw_batches(blend, widths, splats.packed, lists, width, height)
    channels, median = drawn.state
    assert channels is not None
    return Composite(
        channels, drawn.T, None if median is None else median[0], drawn.n_evaluated, drawn.n_blended
    )  # fmt: skip
