"""Gaussians that are drawn as codec `raht` will decode them, differentiable: for fine-tuning before they are encoded.

Source: MesonGS (arXiv 2409.09756), sections on attribute transformation, block quantisation and fine-tuning.
"""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sw_gaussians.surfels import refuse_surfels
from torch import Tensor, nn

from splatwizard_core.api import SH, GaussianInputs, GaussianModel, SplatOptimizer
from sw_codecs.models.attributes import MAX_LOGIT
from sw_codecs.models.raht_settings import RahtOptions, RahtSettings
from sw_codecs.models.voxels import VoxelGrid, one_a_voxel
from sw_codecs.positions import morton
from sw_codecs.quantizers.fake_quant import FakeQuantAffine
from sw_codecs.quantizers.straight_through import straight_through
from sw_codecs.quantizers.vector_quantizer import VectorQuantizer
from sw_codecs.transforms.euler import angles_of, quats_of
from sw_codecs.transforms.raht import RahtPlan

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer

log = logging.getLogger(__name__)

CHANNELS = 7
"""Of the transform: opacity logit, roll, pitch, yaw, SH band 0 of red, green, blue."""


class RahtGaussians(GaussianModel):
    """Gaussians in two states: as trained, until `settle`; after it one a voxel, drawn through the quantised transform.

    importance  [N] buffer, weight of each Gaussian in the codebook
    cells       [N,3] int64 buffer, voxel of each; rows are in Morton order
    code        [N] int64 buffer, codebook entry of each
    codebook    [K,R,3] parameter, SH bands 1 and up: it takes the place of `sh_rest`, which then is empty
    detail      quantizer of the 7 columns of coefficients but for the first row; scale_lattice: of the log scales
    grid        voxel grid; None until `settle`

    The quantizers widen their ranges with whatever is drawn in training mode.
    """

    ROWS = (*GaussianModel.ROWS, "importance", "cells", "code")

    grid: VoxelGrid | None = None
    importance: Tensor
    cells: Tensor
    code: Tensor
    codebook: nn.Parameter

    def __init__(self, *tensors: Tensor, active_sh_degree: int | None = None, bits: int = 8, blocks: int = 66) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        n = len(self.means)
        self.register_buffer("importance", torch.zeros_like(self.opacity_logits))
        self.register_buffer("cells", torch.zeros(n, 3, dtype=torch.int64, device=self.means.device))
        self.register_buffer("code", torch.zeros(n, dtype=torch.int64, device=self.means.device))
        self.codebook = nn.Parameter(self.sh_rest.new_zeros(0, *self.sh_rest.shape[1:]))
        self.detail = FakeQuantAffine(bits, channels=CHANNELS, blocks=blocks)
        self.scale_lattice = FakeQuantAffine(bits, channels=3, blocks=blocks)
        self.to(self.means.device)
        self._plan: tuple[Tensor, RahtPlan] | None = None

    @classmethod
    def of(cls, model: GaussianModel, *, bits: int = 8, blocks: int = 66) -> RahtGaussians:
        """Return copies of those of a model's Gaussians that are finite, not settled.

        Opacity logits become at most +-20: beyond it opacities are 0 or 1, and one such number would spoil a block.
        Raises UserInputError for surfels.
        """
        refuse_surfels(model, "codec raht")
        finite = finite_rows(model)
        if not bool(finite.all()):
            log.info("%d of %d Gaussians are not finite and are left out", int((~finite).sum()), len(finite))
        logits = model.opacity_logits.clamp(-MAX_LOGIT, MAX_LOGIT)
        tensors = (model.means, model.sh_dc, model.sh_rest, logits, model.log_scales, model.quats)
        copies = (t.detach()[finite] for t in tensors)
        return cls(*copies, active_sh_degree=model.active_sh_degree, bits=bits, blocks=blocks)

    @property
    def max_sh_degree(self) -> int:
        """Highest SH band, of the codebook once there is one."""
        held = self.sh_rest if self.grid is None else self.codebook
        return math.isqrt(held.shape[1] + 1) - 1

    def settle(
        self, optimizer: SplatOptimizer, options: RahtOptions, *, depth: int, size: int, generator: torch.Generator
    ) -> None:
        """Merge into voxels, replace SH bands 1 and up by a codebook, observe the ranges of the quantizers.

        optimizer   of this model; of parameters that are replaced it forgets the moments
        depth, size levels of the octree, codebook entries
        generator   on the CPU, of the codebook's training and of what `merge` draws

        `importance` must have been set; where all of it is 0, every Gaussian weighs the same.
        """
        grid = VoxelGrid.fit(_host(self.means), depth, options.anchor)
        cells = grid.cells(_host(self.means))
        names = ("sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
        seed = int(torch.randint(2**62, (), generator=generator))
        first, rows, importance = one_a_voxel(
            morton.encode(cells), {name: _host(getattr(self, name)) for name in names}, _host(self.importance),
            rule=options.merge, generator=np.random.default_rng(seed),
        )  # fmt: skip
        voxels = cells[first]
        fresh = {name: torch.from_numpy(array).to(self.device) for name, array in rows.items()}
        fresh["means"] = torch.from_numpy(grid.points(voxels)).to(self.device)
        fresh["cells"] = torch.from_numpy(voxels).to(self.device)
        fresh["importance"] = torch.from_numpy(importance).to(self.importance)
        rest = fresh.pop("sh_rest").flatten(1)
        codebook, fresh["code"] = codebook_of(rest, fresh["importance"], options, size=size, generator=generator)
        keep = torch.zeros(self.num_rows, dtype=torch.bool, device=self.device)
        keep[: len(first)] = True
        optimizer.keep_rows(self, keep)
        optimizer.set_rows(self, torch.arange(len(first), device=self.device), fresh)
        optimizer.replace(self, "codebook", codebook.reshape(len(codebook), -1, 3))
        optimizer.replace(self, "sh_rest", self.sh_rest[:, :0])
        self.grid = grid
        self.recalibrate()

    @torch.no_grad()
    def recalibrate(self) -> None:
        """Forget the ranges of the quantizers and take those of the Gaussians as they are now."""
        for quantizer in (self.detail, self.scale_lattice):
            quantizer.reset()
        self.detail.observe(self.plan().forward(self.attributes())[1:])
        self.scale_lattice.observe(self.log_scales)

    def after_cut(self) -> None:
        """Forget codebook entries that no row has, and ranges of rows that are gone."""
        used, self.code = torch.unique(self.code, return_inverse=True)
        self.codebook = nn.Parameter(self.codebook.detach()[used], requires_grad=False)
        self.recalibrate()

    def plan(self) -> RahtPlan:
        """Return the plan of the transform over the voxels; kept. The model must be settled."""
        if self._plan is None or self._plan[0] is not self.cells:
            self._plan = (self.cells, RahtPlan(morton.encode(_host(self.cells))))
        return self._plan[1]

    def attributes(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return the channels that are transformed, [N,7] of `dtype`; differentiable."""
        logits, quats, dc = (t.to(dtype) for t in (self.opacity_logits, self.quats, self.sh_dc))
        return torch.cat([logits[:, None], angles_of(quats), dc[:, 0]], 1)

    def quantised(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return attributes [N,7], log scales [N,3] and codebook [K,R,3] as the file will hold them; differentiable."""
        plan = self.plan()
        coefficients = plan.forward(self.attributes())
        attributes = plan.inverse(torch.cat([coefficients[:1], self.detail(coefficients[1:])]))
        entries = straight_through(self.codebook, self.codebook.half().float())
        return attributes, self.scale_lattice(self.log_scales), entries

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        if self.grid is None:
            return super().gaussians(camera, rasterizer)
        attributes, log_scales, entries = self.quantised()
        dc = attributes[:, None, 4:]
        coded = SH(dc=dc, codebook=entries, indices=self.code, active_degree=self.active_sh_degree)
        return GaussianInputs(
            means=self.means,
            opacities=torch.sigmoid(attributes[:, 0]),
            scales=torch.exp(log_scales),
            quats=quats_of(attributes[:, 1:4]),
            sh=coded if self.max_sh_degree else SH(dc=dc, active_degree=0),
        )

    def state_dict_extra(self) -> dict[str, Any]:
        grid = None if self.grid is None else asdict(self.grid)
        return {**super().state_dict_extra(), "grid": grid}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self._plan = None  # the cells may have been loaded in place
        grid = extra["grid"]
        self.grid = None
        if grid is not None:
            low, high = ((float(x), float(y), float(z)) for x, y, z in (grid["low"], grid["high"]))
            self.grid = VoxelGrid(low, high, int(grid["depth"]), grid["anchor"])


@torch.no_grad()
def finite_rows(model: GaussianModel) -> Tensor:
    """Return which Gaussians have finite parameters, [N] bool; an infinite opacity logit is an opacity of 0 or 1."""
    tensors = (model.means, model.sh_dc, model.sh_rest, model.log_scales, model.quats)
    finite = [torch.isfinite(tensor).flatten(1).all(1) for tensor in tensors]
    return torch.stack([*finite, ~torch.isnan(model.opacity_logits)]).all(0)


@torch.no_grad()
def codebook_of(
    rows: Tensor, importance: Tensor, options: RahtOptions, *, size: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return a codebook [K,d] for `rows` [N,d] and the entry of each row, [N] int64, nearest as float16 holds it."""
    n, width = rows.shape
    size = min(size, max(int(n / options.rows_per_code), 1))
    if n == 0 or width == 0:
        return rows.new_zeros(1, width), torch.zeros(n, dtype=torch.int64, device=rows.device)
    quantizer = VectorQuantizer(size, decay=options.vq_decay)
    weights = importance if bool((importance > 0).any()) else torch.ones_like(importance)
    label = "codebook of SH bands 1 and up"
    if options.vq_training == "kmeans":
        quantizer.fit(rows, generator=generator, weights=weights, iterations=options.vq_steps, label=label)
    else:
        quantizer.train(
            rows, weights, options.vq_steps, options.vq_batch, generator=generator, rule="batch-mean", label=label
        )
    assert quantizer.codebook is not None
    quantizer.codebook = quantizer.codebook.half().float()
    return quantizer.codebook, quantizer.assign(rows)


def settled_copy(model: GaussianModel, settings: RahtSettings, *, seed: int) -> RahtGaussians:
    """Return the settled copy of any model; a model with a buffer `importance` [N] is weighted by it.

    Without that buffer opacity times volume^0.1 is the weight.
    """
    found = RahtGaussians.of(model, bits=settings.bits, blocks=settings.blocks)
    given = getattr(model, "importance", None)
    if not isinstance(given, Tensor) or given.shape != (model.num_rows,):
        given = model.opacities.detach() * torch.exp(0.1 * model.log_scales.detach().sum(1).clamp(-100, 100))
    found.importance.copy_(given[finite_rows(model)])
    generator = torch.Generator().manual_seed(seed)
    optimizer = SplatOptimizer(found, [])
    found.settle(optimizer, settings, depth=settings.depth, size=settings.codebook_size, generator=generator)
    return found


def _host(tensor: Tensor) -> Any:
    return tensor.detach().cpu().numpy()
