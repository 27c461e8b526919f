"""Values and gradients on random scenes: finite differences in float64, and one rasterizer against another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import (
    Camera,
    Feature,
    GaussianInputs,
    Rasterizer,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
)
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, margin_scene, with_tensors

DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})

FLAT: dict[str, Any] = {"geometry": "surfels", "width": 12, "height": 10}
GRADIENT_CASES = (
    RasterCase("colors", color="colors"),
    RasterCase("four-channels", color="colors", channels=4),
    RasterCase("sh-degree-3", n=4),
    RasterCase("sh-degree-2", n=4, degree=2, active_degree=2),
    RasterCase("sh-degree-1", n=4, degree=1, active_degree=1),
    RasterCase("sh-degree-0", degree=0, active_degree=0),
    RasterCase("sh-active-1-of-2", n=4, degree=2, active_degree=1),
    RasterCase("sh-clamped", n=5, degree=1, active_degree=1, sh_scale=1.2),
    RasterCase("sh-unclamped", n=5, degree=1, active_degree=1, sh_scale=1.2, options={"clamp_color": False}),
    RasterCase("split", n=4, color="split", degree=1, active_degree=1),
    RasterCase("indexed", n=6, color="indexed", geometry="indexed", degree=1, active_degree=1),
    RasterCase("cov3d", color="colors", geometry="cov3d"),
    RasterCase("features", color="colors", features=2),
    RasterCase("antialias", color="colors", options={"antialias": True}),
    RasterCase("antialias-floor", color="colors", n=4, scale=(1e-4, 4e-4), opacity=(20.0, 40.0),
               options={"antialias": True}),
    RasterCase("jacobian-clamp", color="colors", n=12, spread=3.0, scale=(0.8, 1.6)),
    RasterCase("alpha-clamp", color="colors", n=4, opacity=(1.1, 1.7), scale=(0.3, 0.6)),
    RasterCase("stop", color="colors", n=9, opacity=(0.7, 0.95), scale=(0.7, 1.2), width=12, height=10),
    RasterCase("off-centre", color="colors", principal=(5.0, -3.0)),
    RasterCase("modifier", color="colors", options={"scale_modifier": 1.3}),
    RasterCase("surfels", n=3, degree=1, active_degree=1, principal=(2.0, -1.0), options={"scale_modifier": 1.3},
               **FLAT),
    RasterCase("surfels-low-pass", color="colors", n=5, scale=(0.02, 0.2), spread=0.8, **FLAT),
    RasterCase("surfels-alpha-clamp", color="colors", n=3, opacity=(1.1, 1.7), scale=(0.3, 0.6), **FLAT),
    RasterCase("surfels-stop", color="colors", n=8, opacity=(0.93, 0.985), scale=(0.8, 1.4), spread=0.5, **FLAT),
    RasterCase("surfels-behind", color="colors", n=3, scale=(1.2, 2.7), opacity=(0.2, 0.6), spread=0.7, **FLAT),
)  # fmt: skip
"""Every path that has a derivative of its own."""


def _background(channels: int, height: int, width: int, dtype: torch.dtype) -> Tensor:
    return torch.rand(channels, height, width, generator=torch.Generator().manual_seed(6)).to(dtype)


def _options(case: RasterCase, info: RasterizerInfo, cam: Camera, dtype: torch.dtype) -> RasterOptions:
    """The case's options, with every differentiable output that the rasterizer offers."""
    offered = {"inverse": "DEPTH_INVERSE", "accumulated": "DEPTH_ACCUM", "expected": "DEPTH_EXPECTED",
               "median": "DEPTH_MEDIAN"}  # fmt: skip
    channels = case.channels if case.color == "colors" else 3
    flat = case.geometry == "surfels"
    return case.raster_options(
        background=_background(channels, cam.height, cam.width, dtype),
        alpha="ALPHA_MAP" in info.features,
        depth=frozenset(m for m in DEPTHS if offered[m] in info.features),
        normals=flat and "NORMALS" in info.features,
        distortion=flat and "DISTORTION" in info.features,
    )


def applies(case: RasterCase, info: RasterizerInfo) -> bool:
    """Whether the rasterizer declares what this case needs."""
    g, cam = draw_scene(case, 1)  # any: the needs of a case do not depend on its numbers
    needed = Feature.asked_by(_options(case, info, cam, torch.float64), g).names - {"FLOAT64"}
    return info.needs <= needed <= info.features


def outputs(result: RenderResult) -> dict[str, Tensor]:
    """Every differentiable output that is there, by name."""
    found = {"image": result.image, **{f"depth {m}": d for m, d in result.depth.items()}}
    if result.alpha is not None:
        found["alpha"] = result.alpha
    for name in ("features", "normals", "distortion"):
        if (x := getattr(result, name)) is not None:
            found[name] = x
    return found


def _leaves(g: GaussianInputs) -> dict[str, Tensor]:
    return {name: x.clone().requires_grad_() for name, x in g.tensors().items() if x.is_floating_point()}


def _probe(x: Tensor, seed: int) -> Tensor:
    return torch.randn(x.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(x)


def check_gradients(rasterizer: Rasterizer, case: RasterCase, seed: int = 1) -> None:
    """`torch.autograd.gradcheck` in float64 of a random projection of each output, for every input tensor.

    Along a random direction of each tensor, which no wrong entry of a gradient is orthogonal to. The scene keeps a
    margin to every threshold, so central differences see a smooth function.
    """
    g, cam = margin_scene(case, seed)
    options = _options(case, rasterizer.info, cam, torch.float64)
    leaves = _leaves(g)

    def function(*values: Tensor) -> tuple[Tensor, ...]:
        result = rasterizer.render(with_tensors(g, dict(zip(leaves, values, strict=True))), cam, options)
        return tuple((x * _probe(x, 1)).sum() for x in outputs(result).values())

    limits = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-4}
    assert torch.autograd.gradcheck(
        function, tuple(leaves.values()), **limits, fast_mode=True, check_undefined_grad=False
    )


def run(
    rasterizer: Rasterizer, g: GaussianInputs, cam: Camera, options: RasterOptions
) -> tuple[RenderResult, dict[str, Tensor]]:
    """(result, gradient of every input tensor) under one fixed random weighting of all outputs.

    No gradients from a rasterizer that only draws.
    """
    if "BACKWARD" not in rasterizer.info.features:
        return rasterizer.render(g, cam, options), {}
    leaves = _leaves(g)
    result = rasterizer.render(with_tensors(g, leaves), cam, options)
    loss = sum((x * _probe(x.cpu(), 3).to(x)).sum() for x in outputs(result).values())
    assert isinstance(loss, Tensor)
    torch.autograd.backward(loss)
    return result, {name: x.grad if x.grad is not None else torch.zeros_like(x) for name, x in leaves.items()}


def check_against(
    rasterizer: Rasterizer, oracle: Rasterizer, case: RasterCase, seed: int = 1, device: str = "cpu"
) -> None:
    """Float32 values and gradients of `rasterizer` equal the float64 ones of `oracle` on a margin-filtered scene.

    Outputs to 2e-5 of their largest value, gradients to a relative L2 of 1e-4 and a cosine of 0.9999; radii exactly.
    """
    g, cam = margin_scene(case, seed)
    options = _options(case, rasterizer.info, cam, torch.float64)
    if "BACKWARD" in rasterizer.info.features:
        absgrad = "ABSGRAD" in rasterizer.info.features and case.geometry != "surfels"
        options = replace(options, grad2d=True, absgrad=absgrad)
    expected, expected_gradients = run(oracle, g, cam, options)
    single = cast_inputs(g, torch.float32, device)
    actual, gradients = run(rasterizer, single, cam.to(device, torch.float32), options)
    assert actual.radii.tolist() == expected.radii.tolist()
    wanted = outputs(expected)
    for name, x in outputs(actual).items():
        limit = 2e-5 * max(1.0, float(wanted[name].detach().abs().max()))
        error = float((x.detach().cpu().double() - wanted[name].detach()).abs().max())
        assert error <= limit, f"{case.name}: {name} differs by {error:.3g}, allowed {limit:.3g}"
    pairs = {name: (x, expected_gradients[name]) for name, x in gradients.items()}
    for name, asked in (("grad2d", options.grad2d), ("absgrad2d", options.absgrad)):
        a, b = getattr(actual, name), getattr(expected, name)
        assert (a is not None) == asked, f"{case.name}: {name} was {'not ' if asked else ''}returned"
        if a is not None:
            pairs[name] = (a.value, b.value)
    for name, (a, b) in pairs.items():
        x, y = a.cpu().double().flatten(), b.double().flatten()
        if float(y.norm()) == 0:
            assert float(x.norm()) == 0, f"{case.name}: gradient of {name} must be zero"
            continue
        error = float((x - y).norm() / y.norm())
        cosine = float(x @ y / (x.norm() * y.norm()))
        assert error < 1e-4, f"{case.name}: gradient of {name} has relative error {error:.3g}"
        assert cosine > 0.9999, f"{case.name}: gradient of {name} has cosine {cosine:.6f}"
