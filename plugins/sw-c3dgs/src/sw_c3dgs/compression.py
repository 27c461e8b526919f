"""The step between a trained scene and its fine-tuning: measure sensitivity, drop what no view shows, make codebooks.

Source: C3DGS (arXiv 2401.02436), section on sensitivity-aware vector clustering.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import CameraIterator, EmptyModel, Rasterizer
from sw_c3dgs.model import SharedGaussians
from sw_c3dgs.sensitivity import sensitivities
from sw_c3dgs.shapes import decomposed, normalised_covariances, of_trace_one
from sw_codecs.codebooks.sharing import SharedVectors, share_vectors

if TYPE_CHECKING:
    from collections.abc import Callable

    from sw_c3dgs.config import C3DGSConfig, Codebook

log = logging.getLogger(__name__)


class Compress:
    """Schedule task: give the Gaussians codebooks of colours and shapes, once.

    seed    of the codebooks
    """

    def __init__(self, config: C3DGSConfig, seed: int) -> None:
        self.config, self.seed = config, seed

    def __call__(self, model: SharedGaussians, cameras: CameraIterator, rasterizer: Rasterizer, step: int) -> None:
        """Raise EmptyModel if no training view shows anything."""
        if model.is_shared:
            return
        before = model.num_rows
        color, shape = sensitivities(
            [view.camera for view in cameras], rasterizer, means=model.means, quats=model.quats, shapes=model.shapes,
            opacities=torch.sigmoid(model.opacity_logits), log_factors=model.log_factors, sh_dc=model.sh_dc,
            sh_rest=model.sh_rest,
        )  # fmt: skip
        kept = ((color > self.config.prune_threshold) & finite(model)).nonzero().squeeze(1)
        if not len(kept):
            raise EmptyModel(step)
        colors, tables = self._colors(model, kept, color[kept])
        shapes, more = self._shapes(model, kept, shape[kept])
        model.share(kept, **tables, **more)
        log.info(
            "step %d: %d of %d Gaussians are seen; %d colours (%d own), %d shapes (%d own)",
            step, len(kept), before, len(colors.entries), len(colors.own), len(shapes.entries), len(shapes.own),
        )  # fmt: skip

    def _colors(
        self, model: SharedGaussians, kept: Tensor, sensitivity: Tensor
    ) -> tuple[SharedVectors, dict[str, Tensor]]:
        coefficients = torch.cat([model.sh_dc, model.sh_rest], 1).detach()[kept]  # [n,K,3]
        shared = self._share(coefficients.flatten(1), sensitivity, self.config.color, "colours")
        found = shared.entries.reshape(-1, *coefficients.shape[1:])
        return shared, {"color_index": shared.index, "sh_dc": found[:, :1], "sh_rest": found[:, 1:]}

    def _shapes(
        self, model: SharedGaussians, kept: Tensor, sensitivity: Tensor
    ) -> tuple[SharedVectors, dict[str, Tensor]]:
        own_shapes, own_quats = model.shapes.detach()[kept], model.quats.detach()[kept]
        matrices = normalised_covariances(own_shapes, own_quats)
        shared = self._share(matrices, sensitivity, self.config.shape, "shapes", of_trace_one)
        shapes, quats = decomposed(shared.entries[: len(shared.entries) - len(shared.own)])
        # A shape that is kept needs no matrix in between.
        quats = torch.cat([quats, torch.nn.functional.normalize(own_quats[shared.own], dim=1)])
        return shared, {
            "shape_index": shared.index,
            "shapes": torch.cat([shapes, own_shapes[shared.own]]),
            "quats": quats,
        }

    def _share(
        self,
        x: Tensor,
        sensitivity: Tensor,
        codebook: Codebook,
        label: str,
        project: Callable[[Tensor], Tensor] | None = None,
    ) -> SharedVectors:
        factors = self.config.factors
        return share_vectors(
            x, sensitivity,
            threshold=codebook.threshold * factors.thresholds, size=max(1, round(codebook.size * factors.sizes)),
            training=codebook.training, iterations=codebook.iterations, batch=codebook.batch, decay=codebook.decay,
            generator=torch.Generator().manual_seed(self.seed), project=project, label=label,
        )  # fmt: skip


def finite(model: SharedGaussians) -> Tensor:
    """[N] bool: Gaussians of a model without codebooks that hold no NaN and no infinity."""
    names = ("means", "opacity_logits", "log_factors", "sh_dc", "sh_rest", "shapes", "quats")
    good = [torch.isfinite(getattr(model, name).detach()) for name in names]
    return torch.stack([each if each.ndim == 1 else each.flatten(1).all(1) for each in good]).all(0)
