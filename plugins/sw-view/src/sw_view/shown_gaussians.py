"""Gaussians as arrays that a browser draws by itself: splats, or ellipsoids as meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.covariances import covariances_of
from sw_gaussians.surfels import as_ellipsoids

from splatwizard_core.api import SH_C0, Camera, GaussianModel, Rasterizer, SplatModel

MOST_ELLIPSOIDS = 30_000
SOLID = 0.1
"""Fainter Gaussians are no ellipsoids that one would see."""


@dataclass(frozen=True)
class ShownGaussians:
    """Gaussians as a browser wants them, float32 unless told otherwise.

    means           [N,3]
    quats           [N,4] w,x,y,z of unit length
    scales          [N,3] standard deviations, world units
    colors          [N,3] uint8, of band 0 alone
    opacities       [N,1] in 0..1
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    colors: NDArray[np.uint8]
    opacities: NDArray[np.float32]

    @property
    def covariances(self) -> NDArray[np.float32]:
        """[N,3,3]."""
        return covariances_of(self.quats, self.scales)

    def largest(self, most: int = MOST_ELLIPSOIDS) -> ShownGaussians:
        """Return at most so many of those that are not faint: the ones with the most light, opacity times area."""
        rows = np.flatnonzero(self.opacities[:, 0] >= SOLID)
        if len(rows) > most:
            widths = np.sort(self.scales[rows], axis=1)
            light = self.opacities[rows, 0] * widths[:, 1] * widths[:, 2]
            rows = np.sort(rows[np.argsort(-light, kind="stable")[:most]])
        return ShownGaussians(
            self.means[rows], self.quats[rows], self.scales[rows], self.colors[rows], self.opacities[rows]
        )


@torch.no_grad()
def shown_gaussians(model: SplatModel, camera: Camera, rasterizer: Rasterizer) -> ShownGaussians:
    """Return the Gaussians of a model; of one whose Gaussians depend on the camera those that `camera` sees."""
    if isinstance(model, GaussianModel):
        found = as_ellipsoids(model)
        means, quats, scales, opacities = (
            value.detach() for value in (found.means, found.quats, found.scales, found.opacities)
        )
        colors = 0.5 + SH_C0 * found.sh_dc[:, 0]
    else:
        inputs = model.gaussians(camera.to(model.device), rasterizer).gathered(colors=False)
        assert inputs.scales is not None
        assert inputs.quats is not None
        means, quats, scales, opacities = inputs.means, inputs.quats, inputs.scales, inputs.opacities
        colors = inputs.colors if inputs.colors is not None else torch.full_like(means, 0.5)
    finite = torch.isfinite(torch.cat([means, quats, scales, colors, opacities[:, None]], dim=1)).all(dim=1)
    finite &= quats.norm(dim=1) > 0
    quats = torch.nn.functional.normalize(quats, dim=1)
    kept = [value[finite].float().cpu().numpy() for value in (means, quats, scales, opacities[:, None])]
    eight = (colors[finite].float().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return ShownGaussians(kept[0], kept[1], kept[2], eight, kept[3])


def sphere(divisions: int = 2) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices [V,3] of the unit sphere and faces [F,3]: an octahedron, its faces split so many times."""
    vertices = [np.array(v, np.float64) for v in
                ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]  # fmt: skip
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(divisions):
        middle: dict[tuple[int, int], int] = {}

        def between(a: int, b: int, known: dict[tuple[int, int], int] = middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in known:
                point = vertices[a] + vertices[b]
                known[key] = len(vertices)
                vertices.append(point / np.linalg.norm(point))
            return known[key]

        split = []
        for a, b, c in faces:
            ab, bc, ca = between(a, b), between(b, c), between(c, a)
            split += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = split
    return np.array(vertices, np.float32), np.array(faces, np.uint32)
