"""Neural Gaussians of a view: three small networks map anchors to Gaussians; those with opacity > 0 are kept.

Source: Scaffold-GS (arXiv 2312.00109) as used by HAC (arXiv 2403.14530).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

Networks = tuple[nn.Sequential, nn.Sequential, nn.Sequential]
"""Opacity (-> k), covariance (-> 7 k) and colour (-> 3 k), each Linear, ReLU, Linear on F + 4 inputs."""

GEOMETRY = 7
"""Outputs of the covariance network per Gaussian: 3 scale factors, 4 quaternion components."""


@dataclass(frozen=True)
class NeuralGaussians:
    """M Gaussians with opacity > 0 of V anchors with k offsets each.

    means, opacities, scales, quats, colors     [M,...] as in GaussianInputs; differentiable
    all_opacities   [V,k] in (-1,1), no gradient
    alphas          [V,k] the same before masks
    drawn           [M] int64, which of the V * k they are
    """

    means: Tensor
    opacities: Tensor
    scales: Tensor
    quats: Tensor
    colors: Tensor
    all_opacities: Tensor
    alphas: Tensor
    drawn: Tensor


def spawn(
    center: Tensor,
    positions: Tensor,
    features: Tensor,
    offsets: Tensor,
    scales: Tensor,
    masks: Tensor | None,
    networks: Networks,
) -> NeuralGaussians:
    """Decode the Gaussians of V anchors for a camera at `center` [3], which gets no gradient.

    positions [V,3], features [V,F], offsets [V,k,3], scales [V,6], masks [V,k] or None: as in AnchorAttributes
    """
    mlp_opacity, mlp_cov, mlp_color = networks
    toward = positions - center
    distance = torch.linalg.vector_norm(toward, dim=1, keepdim=True)
    inputs = torch.cat([features, toward / distance, distance], dim=1)  # [V, F+4]
    alphas = torch.tanh(mlp_opacity(inputs))  # [V,k]
    opacities = alphas if masks is None else alphas * masks
    drawn = torch.nonzero(opacities.detach().reshape(-1) > 0).squeeze(1)  # [M]
    owner = torch.div(drawn, alphas.shape[1], rounding_mode="floor")  # [M]
    geometry = mlp_cov(inputs).reshape(-1, GEOMETRY).index_select(0, drawn)
    own = scales.index_select(0, owner)  # [M,6]
    shifts = offsets.reshape(-1, 3).index_select(0, drawn) * own[:, :3]
    return NeuralGaussians(
        means=positions.index_select(0, owner) + shifts,
        opacities=opacities.reshape(-1).index_select(0, drawn),
        # Noise or rounding may take a base scale through zero: a Gaussian of scale -s is that of scale s.
        scales=own[:, 3:].abs() * torch.sigmoid(geometry[:, :3]),
        quats=nn.functional.normalize(geometry[:, 3:], dim=1),
        colors=torch.sigmoid(mlp_color(inputs)).reshape(-1, 3).index_select(0, drawn),
        all_opacities=opacities.detach(),
        alphas=alphas.detach(),
        drawn=drawn,
    )
