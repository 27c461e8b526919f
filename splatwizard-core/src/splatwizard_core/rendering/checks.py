"""What every rasterizer checks before it draws: errors that name the rasterizer and what it can do."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError, ConfigError, ShapeError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.rendering.rasterizer import RasterizerInfo, RasterOptions, check_offered, required_features
from splatwizard_core.scene.camera import Camera

PROFILES = ("3dgs", "dgr-exact")
"""The standard 3DGS rasterizers' drawing profiles: exact support, or the original's tiles and gradients."""


def check_request(info: RasterizerInfo, g: GaussianInputs, opt: RasterOptions) -> None:
    """Raise ShapeError, CapabilityError or ConfigError unless a standard rasterizer can draw `g` with `opt`."""
    g.validate()
    check_offered(info.on(g.means.device.type), required_features(g, opt))
    if opt.profile not in PROFILES:
        raise ConfigError(
            f"rasterizer '{info.name}' knows no profile '{opt.profile}'; one of {', '.join(PROFILES)}",
            key="raster.profile",
        )
    if opt.clamp_grad not in ("exact", "pass"):
        raise ConfigError(f"clamp_grad is '{opt.clamp_grad}', must be 'exact' or 'pass'")


@functools.cache
def dtype_name(dtype: torch.dtype) -> str:
    """As declared: "float32", ..."""
    return str(dtype).removeprefix("torch.")


def check_placement(info: RasterizerInfo, g: GaussianInputs) -> None:
    """Raise CapabilityError or ShapeError unless all tensors share a device kind and a dtype that `info` declares."""
    if g.means.device.type not in info.devices:
        raise CapabilityError(
            f"rasterizer '{info.name}' draws on {', '.join(sorted(info.devices))}, "
            f"the Gaussians are on {g.means.device}",
            missing=(),
        )
    dtype = g.means.dtype
    for name, tensor in g.tensors().items():
        if tensor.is_floating_point() and (tensor.dtype != dtype or dtype_name(dtype) not in info.dtypes):
            raise ShapeError(
                f"rasterizer '{info.name}' needs all tensors in one dtype of {', '.join(sorted(info.dtypes))}: "
                f"{name} is {dtype_name(tensor.dtype)}" + (f", means {dtype_name(dtype)}" if name != "means" else "")
            )


def checked_background(opt: RasterOptions, channels: int, cam: Camera, like: Tensor) -> Tensor | None:
    """The background, [C] or [C,H,W], with device and dtype of `like`; None is black. Raises ShapeError."""
    if opt.background is None:
        return None
    if opt.background.shape not in ((channels,), (channels, cam.height, cam.width)):
        raise ShapeError(
            f"background must be [{channels}] or [{channels}, {cam.height}, {cam.width}], "
            f"got {list(opt.background.shape)}",
            actual=opt.background.shape,
            expected=(channels, cam.height, cam.width),
        )
    return opt.background.to(like)
