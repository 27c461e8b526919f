"""Coding of lists of planes [K, C, H, W] per scale by the entropy model `wavefront`."""

from __future__ import annotations

import numpy as np
import torch

from sw_cat_3dgs.plane_coder import PlaneCoder, PlaneContext


def encode(planes, models) -> bytes:
    """The bytes of planes, orientation k under models[k]."""
    context = PlaneContext(models, [plane.shape[1:] for plane in planes])
    return PlaneCoder().encode(context.join(planes), context)


def decode(data, shapes, models) -> list[np.ndarray]:
    """Inverse of `encode`: shapes are (C, H, W) per scale."""
    context = PlaneContext(models, shapes)
    return context.split(PlaneCoder().decode(data, context))


def table_bits(planes, models) -> float:
    """Bits that `encode` spends on the integers, from the very tables it uses."""
    context = PlaneContext(models, [plane.shape[1:] for plane in planes])
    return float(PlaneCoder().bits(torch.from_numpy(context.join(planes)), context).sum())
