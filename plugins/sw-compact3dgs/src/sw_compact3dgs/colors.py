"""The colour field: a hash grid over contracted space, and a small network that also sees the view direction.

Source: Compact 3D Gaussian Representation for Radiance Field (arXiv 2311.13681), section on geometry-aware colours;
grid of instant-ngp (arXiv 2201.05989); contraction of Mip-NeRF 360 (arXiv 2111.12077).
"""

from __future__ import annotations

import itertools

import torch
from sw_reference.spherical_harmonics import sh_basis
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_codecs.context.hash_grid import HashGrid, real_levels, table_size

DIRECTION_DEGREE = 2
DIRECTION_VALUES = (DIRECTION_DEGREE + 1) ** 2
MAX_RESOLUTION = 1 << 16
ROWS = 1 << 16
"""Gaussians whose features are looked up together where nothing is trained."""


def contract(means: Tensor) -> Tensor:
    """Positions [N,3], world units, as places in the open unit cube; float32.

    Within distance 1 of the origin x -> x / 4 + 1/2; beyond it distances r become 2 - 1/r first. Source: spec of
    Compact3DGS; not scaled to the scene, as the authors' code.
    """
    x = means.float()
    r = torch.linalg.vector_norm(x, dim=1, keepdim=True).clamp_min(1.0)
    found: Tensor = x * ((2 - 1 / r) / r) / 4 + 0.5
    return found


class ColorField(nn.Module):
    """Colours of Gaussians from where they are and where they are seen from.

    grid        HashGrid of real numbers over the contracted cube, F numbers for a place
    layers      F + 9 + 1 inputs (features, SH basis of the direction up to degree 2, a constant 1), two hidden layers
                of `hidden` with ReLU, three outputs; no biases, whose part the constant takes
    """

    def __init__(
        self,
        *,
        levels: int,
        features: int,
        coarsest: int,
        growth: float,
        log2_size: int,
        hidden: int,
        generator: torch.Generator | None,
    ) -> None:
        """generator draws the first values; None: zeros, for a field that is read from a file.

        Raises ValueError for a level out of range.
        """
        super().__init__()
        self.growth, self.hidden = growth, hidden
        self.grid = HashGrid.real_grid(
            3, levels=levels, features=features, log2_size=log2_size, coarsest=coarsest,
            finest=coarsest * growth ** (levels - 1), generator=generator,
        )  # fmt: skip
        widths = [self.grid.width + DIRECTION_VALUES + 1, hidden, hidden, 3]
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in itertools.pairwise(widths))
        for weight in self.weights:
            if generator is None:
                nn.init.zeros_(weight)
            else:
                nn.init.xavier_uniform_(weight, generator=generator)

    @property
    def weights(self) -> list[nn.Parameter]:
        """Weights of the three layers, [outputs, inputs]."""
        return [layer.get_parameter("weight") for layer in self.layers]

    @staticmethod
    def numbers(*, levels: int, features: int, coarsest: int, growth: float, log2_size: int) -> int:
        """Numbers in the grid of such a field, before anything is allocated. Raises ValueError for too fine a level."""
        found = [resolution for _, resolution in real_levels(levels, coarsest, coarsest * growth ** (levels - 1))]
        if found[-1] > MAX_RESOLUTION:
            raise ValueError(f"the finest level has {found[-1]:,} vertices an axis, at most {MAX_RESOLUTION:,} can be")
        return features * sum(table_size(resolution, 3, log2_size) for resolution in found)

    def features(self, means: Tensor) -> Tensor:
        """[N,3] -> [N,F], without a gradient for the positions."""
        found: Tensor = self.grid(contract(means.detach()))
        return found

    @torch.no_grad()
    def all_features(self, means: Tensor) -> Tensor:
        """`features` of many Gaussians in bounded memory."""
        return (
            torch.cat([self.features(part) for part in torch.split(means, ROWS)])
            if len(means)
            else self.features(means)
        )

    def coefficients(self, features: Tensor, means: Tensor, center: Tensor) -> Tensor:
        """SH coefficients of degree 0, [N,3], of Gaussians seen from `center` [3]; 0 is the colour 0.5.

        Differentiable, for the means by way of the direction.
        """
        x = torch.cat([features, sh_basis(F.normalize(means - center, dim=1), DIRECTION_DEGREE)], dim=1)
        x = torch.cat([x, x.new_ones(len(x), 1)], dim=1)
        *hidden, last = self.layers
        for layer in hidden:
            x = torch.relu(layer(x))
        found: Tensor = last(x)
        return found
