"""The translation to gsplat's conventions, against a stand-in that draws with the reference; the real one on a GPU."""

from __future__ import annotations

import sys
import types
from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene

from splatwizard_core.api import SH, Camera, CapabilityError, ConfigError, GaussianInputs, RasterOptions, ScoreSpec
from splatwizard_core.tooling import load_plugins
from sw_gsplat.availability import unavailable
from sw_gsplat.rasterizer import GsplatRasterizer

CASE = RasterCase("gsplat", n=40, width=45, height=37, degree=2, active_degree=1)
on_gpu = [
    pytest.mark.cuda,
    pytest.mark.skipif(unavailable() is not None, reason=str(unavailable())),
]


def stand_in(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d, packed,
    absgrad, rasterize_mode, render_mode, sh_degree=None, covars=None,
):  # fmt: skip
    """gsplat's documented signature and results, drawn by the reference rasterizer."""
    assert not packed
    cam = Camera(
        width=width, height=height, fx=float(Ks[0, 0, 0]), fy=float(Ks[0, 1, 1]), cx=float(Ks[0, 0, 2]),
        cy=float(Ks[0, 1, 2]), R=viewmats[0, :3, :3], tau=viewmats[0, :3, 3], near=near_plane, far=far_plane,
    )  # fmt: skip
    upper = None if covars is None else covars.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    given = GaussianInputs(
        means=means, opacities=opacities, scales=None if covars is not None else scales,
        quats=None if covars is not None else quats, cov3d=upper,
        sh=None if sh_degree is None else SH(dense=colors, active_degree=sh_degree),
        colors=colors if sh_degree is None else None,
    )  # fmt: skip
    depth = frozenset({"accumulated"}) if render_mode == "RGB+D" else frozenset()
    options = RasterOptions(alpha=True, depth=depth, eps2d=eps2d, antialias=rasterize_mode == "antialiased")
    result = ReferenceRasterizer().render(given, cam, options)
    drawn = torch.cat([result.image, *result.depth.values()]).permute(1, 2, 0)[None]
    # The projected centres only have to receive a gradient: one that says which Gaussian and axis it belongs to.
    means2d = means[None, :, :2] * 1.0
    means2d.absgrad = torch.full_like(means2d, 3.0)
    radii = result.radii[:, None].expand(-1, 2)[None]
    conics = torch.tensor([0.25, 0.0, 1 / 9.0]).expand(len(means), 3)[None]
    return drawn + 0 * means2d.sum(), result.alpha.permute(1, 2, 0)[None], {
        "means2d": means2d, "radii": radii, "conics": conics,
    }  # fmt: skip


@pytest.fixture
def gsplat(monkeypatch) -> GsplatRasterizer:
    module = types.ModuleType("gsplat")
    module.rasterization = stand_in
    monkeypatch.setitem(sys.modules, "gsplat", module)
    rasterizer = GsplatRasterizer()
    rasterizer.info = replace(rasterizer.info, devices=frozenset({"cpu", "cuda"}))
    return rasterizer


@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ({}, {}),
        ({"color": "colors", "channels": 7}, {"background": torch.arange(7) / 7}),
        ({"geometry": "cov3d"}, {"antialias": True, "eps2d": 0.1}),
        ({}, {"scale_modifier": 1.5, "alpha": True, "depth": frozenset({"accumulated", "expected"})}),
        ({}, {"background": torch.rand(3, 37, 45, generator=torch.Generator().manual_seed(1))}),
    ],
    ids=["sh", "channels", "covariances", "everything", "background-image"],
)
def test_what_is_asked_of_gsplat_is_what_the_reference_draws(gsplat, changes, options):
    g, cam = draw_scene(replace(CASE, **changes), 5, torch.float32)
    options = RasterOptions(**options)
    actual, expected = gsplat.render(g, cam, options), ReferenceRasterizer().render(g, cam, options)
    torch.testing.assert_close(actual.image, expected.image, rtol=0, atol=1e-5)
    assert set(actual.depth) == set(expected.depth)
    for mode, depth in expected.depth.items():
        torch.testing.assert_close(actual.depth[mode], depth, rtol=1e-5, atol=1e-5)
    assert (actual.alpha is None) == (expected.alpha is None)


def test_hidden_gaussians_are_not_drawn(gsplat):
    g, cam = draw_scene(CASE, 5, torch.float32)
    visible = torch.arange(len(g)) % 2 == 0
    actual = gsplat.render(replace(g, visible=visible), cam, RasterOptions())
    expected = ReferenceRasterizer().render(replace(g, visible=visible), cam, RasterOptions())
    torch.testing.assert_close(actual.image, expected.image, rtol=0, atol=1e-5)


def test_radii_are_the_classic_ones_and_zero_where_culled(gsplat):
    g, cam = draw_scene(CASE, 5, torch.float32)
    g.opacities[0] = 0.0
    radii = gsplat.render(g, cam, RasterOptions()).radii
    drawn = ReferenceRasterizer().render(g, cam, RasterOptions()).radii > 0
    assert radii.dtype == torch.int32
    # conics (1/4, 0, 1/9) of the stand-in: standard deviations 2 and 3 px, so 3 sqrt(9) = 9 px
    assert set(radii[drawn].tolist()) == {9}
    assert set(radii[~drawn].tolist()) <= {0}


def test_statistics_are_in_ndc_units(gsplat):
    g, cam = draw_scene(CASE, 5, torch.float32)
    g.means.requires_grad_()
    result = gsplat.render(g, cam, RasterOptions(grad2d=True, absgrad=True))
    result.image.sum().backward()
    assert result.grad2d is not None
    assert result.absgrad2d is not None
    assert result.grad2d.value.shape == (len(g), 2)
    assert (result.absgrad2d.value == torch.tensor([3 * cam.width / 2, 3 * cam.height / 2])).all()


@pytest.mark.parametrize("options", [{"profile": "dgr-exact"}, {"clamp_grad": "pass"}])
def test_rules_that_gsplat_does_not_have_are_refused(gsplat, options):
    g, cam = draw_scene(CASE, 5, torch.float32)
    with pytest.raises(ConfigError, match="gsplat"):
        gsplat.render(g, cam, RasterOptions(**options))


def test_what_it_does_not_declare_is_refused(gsplat):
    g, cam = draw_scene(CASE, 5, torch.float32)
    with pytest.raises(CapabilityError):
        gsplat.visible_filter(g, cam)
    with pytest.raises(CapabilityError):
        gsplat.accumulate(g, [cam], RasterOptions(scores=(ScoreSpec("hits", "hits"),)))


def test_without_the_package_the_reason_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(CapabilityError, match=r"pip install 'sw-gsplat\[gsplat\]'"):
        GsplatRasterizer()


def test_it_is_found_through_its_entry_point_and_says_why_it_is_not_used():
    entry = load_plugins().rasterizers.entry("gsplat")
    assert entry.declared["devices"] == ["cuda"]
    if not torch.cuda.is_available():
        assert unavailable() is not None


class TestOnAGpu:
    pytestmark = on_gpu

    @pytest.mark.parametrize("changes", [{}, {"geometry": "cov3d"}, {"color": "colors", "channels": 7}], ids=str)
    def test_image_and_gradients_are_those_of_the_reference(self, changes):
        g, cam = draw_scene(replace(CASE, **changes), 6, torch.float32)
        g.opacities.clamp_(max=0.9)  # below both clamps of alpha
        options = RasterOptions(grad2d=True, absgrad=True)
        weight = torch.rand(
            3 if g.colors is None else 7, cam.height, cam.width, generator=torch.Generator().manual_seed(2)
        )
        found = {}
        for name, rasterizer, device in (
            ("ours", ReferenceRasterizer(), "cpu"),
            ("gsplat", GsplatRasterizer(), "cuda"),
        ):
            inputs = cast_inputs(g, torch.float32, device)
            inputs.means.requires_grad_()
            inputs.opacities.requires_grad_()
            result = rasterizer.render(inputs, cam, options)
            (result.image * weight.to(device)).sum().backward()
            found[name] = {
                "image": result.image, "means": inputs.means.grad, "opacities": inputs.opacities.grad,
                "grad2d": result.grad2d.value, "absgrad2d": result.absgrad2d.value,
            }  # fmt: skip
        for name, expected in found["ours"].items():
            error = (found["gsplat"][name].detach().cpu() - expected.detach()).norm() / expected.detach().norm()
            assert error < 1e-3, name
