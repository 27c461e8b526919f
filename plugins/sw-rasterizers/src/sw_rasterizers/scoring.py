"""Scores and Fisher blocks of Gaussians over views, on compiled kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import AccumOutput, CapabilityError, GaussianInputs, RasterOptions, ScoreSpec
from sw_rasterizers.native import MODULE
from sw_rasterizers.ops import Call

KINDS = (
    "hits", "opacity", "opacity_T", "blend", "blend_max", "gamma", "dist", "blend_sq", "shown", "grad_sq", "removal",
)  # fmt: skip
"""Score kinds, in the order of `enum ScoreKind` in csrc/scores.h."""
MAX_SCORES = 32
"""Largest number of scores per call; `kMaxScores` of csrc/scores.h."""
FISHER = 21
"""Length of a Fisher block: upper triangle of 6x6, row by row."""


class Totals:
    """Running sums over views in float64: scores [K,N], Fisher blocks [N,21] if asked for."""

    def __init__(self, g: GaussianInputs, opt: RasterOptions) -> None:
        like = g.means
        self.specs = opt.scores
        self.scores = like.new_zeros(len(opt.scores), len(g), dtype=torch.float64)
        self.fisher = like.new_zeros(len(g), FISHER, dtype=torch.float64) if opt.fisher else None

    def result(self) -> AccumOutput:
        """Return the sums in the contract's dtypes: counts as int32, others as float32."""
        limit = torch.iinfo(torch.int32).max
        scores = {
            spec.name: (row.clamp(max=limit) if spec.dtype == torch.int32 else row).to(spec.dtype)
            for spec, row in zip(self.specs, self.scores, strict=True)
        }
        return AccumOutput(scores, None if self.fisher is None else self.fisher.float())


def check_count(specs: tuple[ScoreSpec, ...]) -> None:
    """Raise CapabilityError for more scores than one call forms."""
    if len(specs) > MAX_SCORES:
        raise CapabilityError(f"at most {MAX_SCORES} scores are formed at once, got {len(specs)}", missing=())


def add_scores(g: GaussianInputs, call: Call, opt: RasterOptions, totals: Totals) -> None:
    """Add the scores and Fisher blocks of one view to `totals`.

    call    the view as it is drawn without maps and features, which change no score

    Sums per tile are in the dtype of the Gaussians, sums across tiles and views in float64. On the CPU they are
    bit-equal for any number of threads. On CUDA the order of additions varies, unless torch uses deterministic
    algorithms; then a Gaussian's sum over the tiles of a view is float32, too. No score is differentiable, and none
    touches a gradient.
    """
    MODULE.load()
    sh = g.sh
    tensors = (
        g.means, g.opacities, g.scales, g.quats, g.cov3d, None if sh is None else sh.dense,
        None if sh is None else sh.dc, None if sh is None else sh.rest, g.colors,
    )  # fmt: skip
    weights, rows = _pixel_weights(opt.scores, g.means)
    torch.ops.sw_rasterizers.accumulate_scores(
        *(None if x is None else x.detach().contiguous() for x in tensors), call.visible, call.background,
        *call.settings(),
        [KINDS.index(s.kind) for s in opt.scores], [int(s.rule == "tested") for s in opt.scores],
        [float(s.gamma) for s in opt.scores], rows, weights, totals.scores, totals.fisher,
    )  # fmt: skip


def _pixel_weights(specs: tuple[ScoreSpec, ...], like: Tensor) -> tuple[Tensor | None, list[int]]:
    """Return pixel-weight maps [M,H,W], and the map index per score (first of a residual's three); -1: none."""
    maps: list[Tensor] = []
    rows = []
    for spec in specs:
        given = spec.pixel_weight if spec.residual is None else spec.residual
        rows.append(-1 if given is None else len(maps))
        if given is not None:
            maps.extend(given.detach().to(like).reshape(-1, *given.shape[-2:]))
    return (torch.stack(maps).contiguous() if maps else None), rows
