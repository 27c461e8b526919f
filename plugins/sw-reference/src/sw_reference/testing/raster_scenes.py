"""Small random scenes for checking rasterizers, drawn so that no pixel sits on a threshold."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import SH, Camera, GaussianInputs, RasterOptions
from sw_reference.projection import covariances
from sw_reference.testing.naive_rasterizer import naive_render

MARGIN = 1e-3


@dataclass(frozen=True)
class RasterCase:
    """Description of a random scene.

    color       "sh" (dense), "split" (dc + rest), "indexed" (codebook), "colors" ([N,C])
    geometry    "scales" (with unnormalised quats), "surfels" (two scales), "cov3d", "indexed" (codebook with scale
                factors)
    spread      half width of the cloud at the camera's distance of 4; above 2.5 the Jacobian clamp is active
    opacity     (lowest, highest)
    """

    name: str = "plain"
    n: int = 7
    width: int = 21
    height: int = 18
    degree: int = 3
    active_degree: int = 3
    color: str = "sh"
    channels: int = 3
    geometry: str = "scales"
    features: int = 0
    spread: float = 1.0
    scale: tuple[float, float] = (0.1, 0.4)
    opacity: tuple[float, float] = (0.2, 0.9)
    principal: tuple[float, float] = (0.0, 0.0)
    sh_scale: float = 0.15
    options: dict[str, Any] = field(default_factory=dict)

    def raster_options(self, **changes: Any) -> RasterOptions:
        """The case's own options with `changes` on top."""
        return RasterOptions(**{**self.options, **changes})


def draw_scene(case: RasterCase, seed: int, dtype: torch.dtype = torch.float64) -> tuple[GaussianInputs, Camera]:
    """One scene of this kind, all tensors leaves without gradient; no margins are looked at."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n, rows = case.n, case.n if case.geometry != "indexed" else 4
    means = rand(n, 3, low=-case.spread, high=case.spread)
    means[:, 2].clamp_(-1.5, 1.5)
    quats = randn(rows, 4) * rand(rows, 1, low=0.5, high=2.0)
    scales = rand(rows, 3, low=case.scale[0], high=case.scale[1])
    g = GaussianInputs(means, rand(n, low=case.opacity[0], high=case.opacity[1]))
    if case.geometry == "cov3d":
        S = covariances(scales, quats)
        g.cov3d = torch.stack([S[:, 0, 0], S[:, 0, 1], S[:, 0, 2], S[:, 1, 1], S[:, 1, 2], S[:, 2, 2]], dim=1)
    else:
        g.scales, g.quats = scales[:, :2] if case.geometry == "surfels" else scales, quats
    if case.geometry == "indexed":
        g.geom_indices = torch.randint(rows, (n,), generator=generator)
        g.scale_factors = rand(n, low=0.7, high=1.4)
    if case.color == "colors":
        g.colors = rand(n, case.channels)
    else:
        sh = randn(n, (case.degree + 1) ** 2, 3) * case.sh_scale
        sh[:, 0] = randn(n, 3) * 0.8 + 0.6
        if case.color == "sh":
            g.sh = SH(dense=sh, active_degree=case.active_degree)
        elif case.color == "split":
            g.sh = SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=case.active_degree)
        else:
            indices = torch.randint(4, (n,), generator=generator)
            g.sh = SH(codebook=sh[:4].clone(), indices=indices, active_degree=case.active_degree)
    if case.features:
        g.features = randn(n, case.features)

    eye = torch.tensor([0.3, -0.4, -4.0], dtype=torch.float64)
    cam = Camera.look_at(
        eye, torch.tensor([0.05, 0.1, 0.0], dtype=torch.float64), torch.tensor([0.1, -1.0, 0.0], dtype=torch.float64),
        width=case.width, height=case.height, fov_x=0.8,
    )  # fmt: skip
    cam = replace(cam, cx=cam.cx + case.principal[0], cy=cam.cy + case.principal[1], fy=cam.fy * 1.1)
    return cast_inputs(g, dtype), cam.to(dtype=dtype)


_FOUND: dict[str, int] = {}
"""Attempt of each scene that kept its margin, by what was asked for."""


def margin_scene(
    case: RasterCase, seed: int, dtype: torch.dtype = torch.float64, margin: float = MARGIN
) -> tuple[GaussianInputs, Camera]:
    """Redraw until no alpha, transmittance, colour, slope or depth is within `margin` (relative) of a threshold."""
    key = repr((case, seed, margin))  # many tests draw the same scene, and finding it takes far longer than drawing it
    for attempt in range(200) if key not in _FOUND else [_FOUND[key]]:
        g, cam = draw_scene(case, 1000 * seed + attempt)
        if key in _FOUND or naive_render(g, cam, case.raster_options()).margin > margin:
            _FOUND[key] = attempt
            return cast_inputs(g, dtype), cam.to(dtype=dtype)
    raise RuntimeError(f"no scene of kind '{case.name}' keeps a margin of {margin}; use fewer Gaussians or pixels")


def _map(g: GaussianInputs, change: Any) -> GaussianInputs:
    names = ("means", "opacities", "scales", "quats", "cov3d", "geom_indices", "scale_factors", "colors",
             "features", "visible")  # fmt: skip
    fields = {name: change(name, getattr(g, name)) for name in names if getattr(g, name) is not None}
    sh = None
    if g.sh is not None:
        parts = {k: getattr(g.sh, k) for k in ("dense", "dc", "rest", "codebook", "indices")}
        sh = SH(
            **{k: change(f"sh.{k}", v) for k, v in parts.items() if v is not None}, active_degree=g.sh.active_degree
        )
    return GaussianInputs(**fields, sh=sh)


def cast_inputs(g: GaussianInputs, dtype: torch.dtype | None = None, device: str | None = None) -> GaussianInputs:
    """A detached copy with floating tensors in `dtype`, everything on `device`."""
    return _map(g, lambda _, x: x.detach().clone().to(device=device, dtype=dtype if x.is_floating_point() else x.dtype))


def with_tensors(g: GaussianInputs, tensors: dict[str, Tensor]) -> GaussianInputs:
    """The same inputs with some tensors replaced, named as in `GaussianInputs.tensors()`."""
    return _map(g, lambda name, x: tensors.get(name, x))


def permute_inputs(g: GaussianInputs, order: Tensor) -> GaussianInputs:
    """Gaussians reordered, or a subset of them (codebooks stay)."""
    per_row = {"means", "opacities", "cov3d", "geom_indices", "scale_factors", "colors", "features", "visible",
               "sh.dense", "sh.dc", "sh.rest", "sh.indices"}  # fmt: skip
    if g.geom_indices is None:
        per_row |= {"scales", "quats"}
    return _map(g, lambda name, x: x[order] if name in per_row else x)


def concatenate_inputs(a: GaussianInputs, b: GaussianInputs) -> GaussianInputs:
    """Both sets drawn together; same fields in both, no codebooks."""
    other = b.tensors()
    return _map(a, lambda name, x: torch.cat([x, other[name]]))


def front_camera(width: int = 64, height: int = 64, **changes: float) -> Camera:
    """At the origin, looking along +z, focal length 64 px, principal point in the centre."""
    cam = Camera(width, height, 64.0, 64.0, width / 2, height / 2, torch.eye(3), torch.zeros(3))
    return replace(cam, **changes)  # type: ignore[arg-type]


def splats(
    means: list[list[float]], *, opacities: list[float], scales: list[float] | None = None, colors: Tensor | None = None
) -> GaussianInputs:
    """Isotropic Gaussians, default scale 0.2, default colours distinct and fixed; float32 on the CPU."""
    n = len(means)
    if colors is None:
        colors = 0.2 + 0.6 * torch.rand(n, 3, generator=torch.Generator().manual_seed(5))
    size = torch.tensor(scales if scales is not None else [0.2] * n, dtype=torch.float32)
    return GaussianInputs(
        torch.tensor(means, dtype=torch.float32).reshape(n, 3),
        torch.tensor(opacities, dtype=torch.float32),
        size[:, None].repeat(1, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        colors=colors,
    )
