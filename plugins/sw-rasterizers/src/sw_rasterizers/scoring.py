"""Scores and Fisher blocks of Gaussians over views, on compiled kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import AccumOutput, CapabilityError, GaussianInputs, RasterOptions, ScoreSpec
from sw_rasterizers import cpu, cuda, cuda_face, face
from sw_rasterizers.call import INPUTS, Call, Flag, tensors_of
from sw_rasterizers.cpu import SAVE
from sw_rasterizers.memory import empty

KINDS = (
    "hits", "opacity", "opacity_T", "blend", "blend_max", "gamma", "dist", "blend_sq", "shown", "grad_sq", "removal",
)  # fmt: skip
"""Score kinds, in the order of `enum ScoreKind` in csrc/scores.h."""
SENSITIVE = KINDS.index("grad_sq")
"""The kinds from here on depend on the light behind a splat; `is_sensitive` of csrc/scores.h."""
SCORED = tuple(name for name in INPUTS if name not in ("features", "scale_factors"))
"""Inputs that the kernels of scores take."""
MAX_SCORES = 32
"""Largest number of scores per call; `kMaxScores` of csrc/scores.h."""
FISHER = 21
"""Length of a Fisher block: upper triangle of 6x6, row by row."""
FISHER_SUMS = 28
"""Sums of a pair that blocks are made from."""


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
    tensors = {name: None if x is None else x.detach().contiguous() for name, x in tensors_of(g, SCORED).items()}
    if not g.means.is_cuda:
        _add_on_cpu(tensors, call, opt.scores, totals)
        return
    _add_on_cuda(tensors, call, opt.scores, totals)


def _add_on_cuda(tensors: cpu.Tensors, call: Call, specs: tuple[ScoreSpec, ...], totals: Totals) -> None:
    flags = (int(call.flags) | SAVE | cuda.FOR_SCORES) & ~cuda.COUNT
    named: cpu.Tensors = {"features": None, "scale_factors": None, **tensors}
    means = named["means"]
    if len(means) == 0:
        return
    picture = cpu.Picture(call, named, flags)
    kept = cuda.draw(picture, named).kept
    assert kept is not None
    scratch, sizes = None, None
    if flags & cuda.ORDERED:
        sizes = cuda.plan_sums(picture, len(means), kept, means.get_device())
        most = max(sizes.score_bytes if specs else 0, sizes.fisher_bytes if totals.fisher is not None else 0)
        scratch = means.new_empty(most, dtype=torch.uint8)
    view = {
        "lists": kept.lists, "pair_splats": kept.pair_splats, **kept.sizes, "count": len(means), "scratch": scratch,
        **picture.view, **picture.canvas,
    }  # fmt: skip
    if specs:
        cuda_face.accumulate_scores(
            **view, real_bytes=4, scores=len(specs), kinds=[KINDS.index(spec.kind) for spec in specs],
            tested=[spec.rule == "tested" for spec in specs], gammas=[float(spec.gamma) for spec in specs],
            weights=_weights(specs, means), totals=list(totals.scores),
        )  # fmt: skip
    if totals.fisher is not None:
        cuda_face.accumulate_fisher(
            **view, **named, **picture.how, geom_indices=None, visible=call.visible, drawn=kept.drawn,
            rows=means.new_zeros(kept.sizes["used"], FISHER_SUMS), blocks=totals.fisher,
        )  # fmt: skip


def _add_on_cpu(tensors: cpu.Tensors, call: Call, specs: tuple[ScoreSpec, ...], totals: Totals) -> None:
    flags = call.flags | Flag.SAVE
    if totals.fisher is None:
        flags |= Flag.FOR_SCORES
    picture = cpu.Picture(call, tensors, int(flags))
    projected = cpu.project(picture, tensors)
    means, pairs = tensors["means"], projected.found.pairs
    assert means is not None
    if pairs == 0:
        return
    kinds = [KINDS.index(spec.kind) for spec in specs]
    sensitive = [i for i, kind in enumerate(kinds) if kind >= SENSITIVE]
    # What these need of each pixel comes with the picture.
    image = picture.empty_image(means.dtype) if sensitive or totals.fisher is not None else None
    _, lists = cpu.make_lists(picture, projected, image)
    view = {"splats": projected.splats, "lists": lists, "pairs": pairs, **picture.view, **picture.canvas}
    weights = _weights(specs, means)
    for family in ([i for i in range(len(specs)) if i not in sensitive], sensitive):
        if family:
            face.add_scores(
                **view, count=len(means), kinds=[kinds[i] for i in family],
                tested=[specs[i].rule == "tested" for i in family],
                gammas=[float(specs[i].gamma) for i in family], weights=[weights[i] for i in family],
                totals=[totals.scores[i] for i in family], sums=empty((pairs, len(family)), means.dtype),
            )  # fmt: skip
    if totals.fisher is not None:
        face.add_fisher(
            **view, means=means, scales=tensors["scales"], quats=tensors["quats"], sh_degree=call.sh_degree,
            scale_modifier=call.scale_modifier, eps2d=call.eps2d, count=len(means), blocks=totals.fisher,
            sums=empty((pairs, FISHER_SUMS), means.dtype),
        )  # fmt: skip


def _weights(specs: tuple[ScoreSpec, ...], like: Tensor) -> list[Tensor | None]:
    """Return the weights [H,W] of pixels, or the residual [3,H,W], or None, for each score."""
    found = [spec.pixel_weight if spec.residual is None else spec.residual for spec in specs]
    return [None if x is None else x.detach().to(like).contiguous() for x in found]
