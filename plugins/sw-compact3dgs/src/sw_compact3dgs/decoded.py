"""The scene as it comes out of a file: final positions, shapes and opacities, and the colour field."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor, nn

from splatwizard_core.api import GaussianInputs, SplatModel
from sw_compact3dgs.model import drawn

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer
    from sw_compact3dgs.colors import ColorField


class DecodedGaussians(SplatModel):
    """N Gaussians of a file, activated.

    means       [N,3] world units, values of float16
    opacities   [N] in 0..1
    scales      [N,3] world units, > 0
    quats       [N,4] w, x, y, z: sums of codebook entries, of about length 1 (rasterizers normalise)
    color       the colour field
    """

    ROWS = ("means", "opacities", "scales", "quats")

    _features: Tensor | None

    def __init__(self, means: Tensor, opacities: Tensor, scales: Tensor, quats: Tensor, *, color: ColorField) -> None:
        super().__init__()
        self.means, self.opacities = nn.Parameter(means), nn.Parameter(opacities)
        self.scales, self.quats = nn.Parameter(scales), nn.Parameter(quats)
        self.color = color
        self.register_buffer("_features", None, persistent=False)

    def prepare(self) -> None:
        """Look up the features of all Gaussians, [N,F], which no view changes."""
        self._features = self.color.all_features(self.means)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians with the colours of this camera, those that it does not see in grey."""
        inputs = GaussianInputs(
            means=self.means, opacities=self.opacities, scales=self.scales, quats=self.quats, colors=self.means
        )
        return drawn(inputs, self.color, self._features, camera, rasterizer)
