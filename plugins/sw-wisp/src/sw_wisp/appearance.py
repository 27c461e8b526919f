"""Colours of splats: three numbers for the mean colour, and latents that a small network turns into SH bands 1 to 3.

The network is asked once for each splat, when a file is decoded (or at each step of a training), never for a view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_core.api import SH_C0
from sw_wisp.eight_bits import EightBitLayer, rounded_weights

COLOURS = 3


def _rotation(like: Tensor) -> Tensor:
    """[3,3], orthonormal: rows are luma and two chromas of r, g, b."""
    a, b, c = 1 / math.sqrt(3), 1 / math.sqrt(2), 1 / math.sqrt(6)
    return like.new_tensor([[a, a, a], [b, 0, -b], [-c, 2 * c, -c]])


def colour_of(sh_dc: Tensor) -> Tensor:
    """Return luma and chroma [N,3] of the colour 0.5 + C0 dc of SH band 0, [N,1,3]."""
    return (0.5 + SH_C0 * sh_dc[:, 0]) @ _rotation(sh_dc).T


def sh_dc_of(colour: Tensor) -> Tensor:
    """Return SH band 0 [N,1,3] of luma and chroma [N,3]; differentiable."""
    return ((colour @ _rotation(colour) - 0.5) / SH_C0)[:, None]


class AppearanceNetwork(nn.Module):
    """SH bands 1 to `degree` of splats: B a + W2 relu(W1 [a, colour] + b1) + b2 for latents a.

    basis       B [K,latents], K = 3 ((degree + 1)^2 - 1) numbers: all three colours of a coefficient together
    hidden      W1, b1
    out         W2, b2; zero at first, so that a splat with a = 0 looks the same from every side

    rounds      whether it computes with the weights of the file, of eight bits, with straight-through gradients

    With 12 latents, 32 hidden numbers and degree 3: 2,537 numbers.
    """

    def __init__(
        self, latents: int = 12, hidden: int = 32, degree: int = 3, *, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.degree, self.rounds = degree, False
        outputs = 3 * ((degree + 1) ** 2 - 1)
        basis = torch.randn(outputs, latents, generator=generator)
        self.basis = nn.Parameter(torch.linalg.qr(basis).Q.contiguous() if outputs >= latents else basis)
        self.hidden = nn.Linear(latents + COLOURS, hidden)
        self.out = nn.Linear(hidden, outputs)
        with torch.no_grad():
            bound = 1 / math.sqrt(latents + COLOURS)
            self.hidden.weight.copy_((2 * torch.rand(self.hidden.weight.shape, generator=generator) - 1) * bound)
            nn.init.zeros_(self.hidden.bias)
            nn.init.zeros_(self.out.weight)
            nn.init.zeros_(self.out.bias)

    def forward(self, latents: Tensor, colour: Tensor) -> Tensor:
        """Return SH coefficients [N,K/3,3] of bands 1 and up for latents [N,A] and colours [N,3]; differentiable."""
        basis, first, last = self.basis, self.hidden.weight, self.out.weight
        if self.rounds:
            basis, first, last = (rounded_weights(weight) for weight in (basis, first, last))
        inner = torch.relu(F.linear(torch.cat([latents, colour], dim=1), first, self.hidden.bias))
        rest: Tensor = F.linear(inner, last, self.out.bias) + latents @ basis.T
        return rest.view(len(latents), -1, 3)

    def layers(self) -> tuple[EightBitLayer, ...]:
        """Return what the file holds: B, W1 with b1, W2 with b2."""
        pairs = ((self.basis, None), (self.hidden.weight, self.hidden.bias), (self.out.weight, self.out.bias))
        arrays = [[None if t is None else t.detach().cpu().double().numpy() for t in pair] for pair in pairs]
        return tuple(EightBitLayer.nearest(weight, bias) for weight, bias in arrays)  # type: ignore[arg-type]

    @classmethod
    def of_layers(cls, layers: Sequence[EightBitLayer], degree: int) -> AppearanceNetwork:
        """Return the network that a file holds. Raises ValueError for layers that do not fit together."""
        (basis, _), (first, first_bias), (last, last_bias) = (layer.floats() for layer in layers)
        outputs, latents = basis.shape
        hidden, bands = len(first), 3 * degree * (degree + 2)
        if first.shape[1] != latents + COLOURS or last.shape != (outputs, hidden) or outputs != bands:
            raise ValueError(f"no appearance network has layers {basis.shape}, {first.shape}, {last.shape}")
        network = cls(latents, hidden, degree)
        with torch.no_grad():
            network.basis.copy_(torch.from_numpy(basis))
            network.hidden.weight.copy_(torch.from_numpy(first))
            network.hidden.bias.copy_(torch.from_numpy(first_bias))
            network.out.weight.copy_(torch.from_numpy(last))
            network.out.bias.copy_(torch.from_numpy(last_bias))
        return network

    @torch.no_grad()
    def fit(self, sh_rest: Tensor, weights: Tensor) -> Tensor:
        """Take the principal directions of sh_rest [N,K/3,3], weighted by `weights` [N] >= 0; return latents [N,A].

        The mean goes into b2. Directions are orthonormal, in SH units: one of little energy needs few bits as it is.
        """
        flat = sh_rest.flatten(1).double()
        share = (weights.double() / weights.double().sum().clamp_min(1e-30))[:, None]
        share = torch.where(share.isfinite(), share, torch.full_like(share, 1 / len(flat)))
        mean = (flat * share).sum(0)
        centred = flat - mean
        _, directions = torch.linalg.eigh((centred * share).T @ centred)  # ascending
        basis = directions.flip(1)[:, : self.basis.shape[1]]
        self.basis.copy_(basis.to(self.basis))
        self.out.bias.copy_(mean.to(self.out.bias))
        return (centred @ basis).to(sh_rest)
