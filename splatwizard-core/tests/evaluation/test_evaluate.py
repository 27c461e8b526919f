"""Evaluating over views: what is asked of the rasterizer, what is averaged, what is kept."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatwizard_core.errors import BitstreamError, CapabilityError, SceneError
from splatwizard_core.evaluation.evaluate import (
    evaluate,
    png_names,
    raster_header,
    render_options,
    suggested_rasterizers,
)
from splatwizard_core.evaluation.metrics import MetricInfo
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins.registry import Registry
from splatwizard_core.rendering.rasterizer import RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import View
from splatwizard_native import NativeBuildError


def views(*greys: int) -> list[View]:
    """8x8 pictures of one grey level each."""
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, torch.eye(3), torch.zeros(3))
    return [
        View(camera, f"folder/{i}.jpg", lambda grey=grey: np.full((8, 8, 3), grey, np.uint8))
        for i, grey in enumerate(greys)
    ]


class FlatModel(SplatModel):
    """Four Gaussians that nobody looks at."""

    def __init__(self) -> None:
        super().__init__()
        self.means = torch.nn.Parameter(torch.zeros(4, 3))

    def gaussians(self, camera: Camera, rasterizer: object) -> GaussianInputs:
        return GaussianInputs(self.means, torch.ones(4), colors=torch.ones(4, 3), cov3d=torch.ones(4, 6))


class FlatRasterizer:
    """Draws its background, times two in the first channel; sees three of four Gaussians."""

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        assert opt.background is not None
        image = opt.background[:, None, None].expand(3, cam.height, cam.width).clone()
        image[0] *= 2
        return RenderResult(image, torch.tensor([1, 2, 3, 0]), g)


class Metrics:
    """Stands in for the plugin manager."""

    def __init__(self, **targets: str) -> None:
        self.metrics = Registry("metric")
        for name, target in targets.items():
            self.metrics.add(name, target, summary="", direction="higher")


IMAGE = "splatwizard_core.evaluation.image"


def run(pictures: list[View], background: float = 0.5, save_to: Path | None = None, **metrics: str):
    plugins = Metrics(**(metrics or {"psnr": f"{IMAGE}:psnr", "l1": f"{IMAGE}:l1"}))
    options = RasterOptions(background=torch.full((3,), background))
    return evaluate(
        FlatModel(), pictures, FlatRasterizer(), plugins,  # type: ignore[arg-type]
        device=torch.device("cpu"), options=options, save_to=save_to,
    )  # fmt: skip


def test_renders_are_clamped_and_rounded_and_the_mean_is_that_of_the_views():
    result = run(views(255, 0), background=0.75)
    # 0.75 becomes 191/255; the first channel, 1.5, becomes 1.
    grey = 191 / 255
    assert result.metrics["l1"].per_view == pytest.approx([2 * (1 - grey) / 3, (1 + 2 * grey) / 3], abs=1e-7)
    assert result.metrics["l1"].mean == pytest.approx(sum(result.metrics["l1"].per_view) / 2)
    assert result.views == ["folder/0.jpg", "folder/1.jpg"]
    assert (result.visible_gaussians, result.drawn_gaussians) == (3.0, 4.0)


def test_identical_images_make_psnr_null_with_its_reason():
    result = run(views(0), background=0.0)
    assert result.metrics["psnr"].per_view == [None]
    assert result.metrics["psnr"].mean is None
    assert "infinite" in (result.metrics["psnr"].reason or "")
    assert result.metrics["l1"].mean == 0.0


def test_a_render_that_is_not_finite_is_not_taken_for_a_perfect_one():
    result = run(views(0, 9), background=math.nan)
    assert result.metrics["psnr"].per_view == [None, None]
    assert "not a number" in (result.metrics["psnr"].reason or "")


def test_a_metric_for_unrounded_renders_gets_them(monkeypatch: pytest.MonkeyPatch):
    plugins = Metrics(l1=f"{IMAGE}:l1")
    plugins.metrics.add("l1_unrounded", f"{IMAGE}:l1", summary="", direction="lower", unrounded=True, diagnostic=True)
    result = evaluate(
        FlatModel(), views(0), FlatRasterizer(), plugins,  # type: ignore[arg-type]
        device=torch.device("cpu"), options=RasterOptions(background=torch.full((3,), 0.3)),
    )  # fmt: skip
    assert result.metrics["l1_unrounded"].mean == pytest.approx((0.6 + 0.3 + 0.3) / 3, abs=1e-7)
    assert result.metrics["l1"].mean == pytest.approx((153 + 76 + 76) / 255 / 3, abs=1e-7)
    assert result.metrics["l1_unrounded"].diagnostic
    assert not result.metrics["l1"].diagnostic


def pixels_seen(render: torch.Tensor, truth: torch.Tensor) -> float:
    assert render.shape == truth.shape
    return float(render.shape[1] * render.shape[2])


def test_a_pixelwise_metric_gets_what_is_inside_the_mask_where_the_protocol_cuts_pictures_out():
    own = Metrics()
    own.metrics.add("inside", f"{__name__}:pixels_seen", summary="", direction="higher", pixelwise=True)
    own.metrics.add("whole", f"{__name__}:pixels_seen", summary="", direction="higher")
    found = {}
    for masked in (False, True):
        pictures = views(128)
        pictures[0].load_mask = lambda: np.arange(64).reshape(8, 8) < 10
        result = evaluate(
            FlatModel(), pictures, FlatRasterizer(), own,  # type: ignore[arg-type]
            device=torch.device("cpu"), options=RasterOptions(background=torch.full((3,), 0.5)), masked=masked,
        )  # fmt: skip
        found[masked] = {name: metric.mean for name, metric in result.metrics.items() if name in ("inside", "whole")}
    assert found == {False: {"inside": 64, "whole": 64}, True: {"inside": 10, "whole": 64}}


def no_weights(render: torch.Tensor, truth: torch.Tensor) -> float:
    raise CapabilityError("weights missing")


def test_a_metric_that_cannot_run_or_load_is_null_with_its_reason(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(f"{IMAGE}.ssim", no_weights)
    result = run(views(0, 1), weights=f"{IMAGE}:ssim", gone="no_such_module:x", l1=f"{IMAGE}:l1")
    assert (result.metrics["weights"].mean, result.metrics["weights"].reason) == (None, "weights missing")
    assert "no_such_module" in (result.metrics["gone"].reason or "")
    assert result.metrics["l1"].mean is not None


def breaks(render: torch.Tensor, truth: torch.Tensor) -> float:
    raise SystemExit("the sky fell")


def test_a_metric_that_breaks_is_null_and_harms_no_other(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(f"{IMAGE}.ssim", breaks)
    result = run(views(0, 1), broken=f"{IMAGE}:ssim", l1=f"{IMAGE}:l1")
    assert result.metrics["broken"].mean is None
    assert "metric 'broken'" in (result.metrics["broken"].reason or "")
    assert "the sky fell" in (result.metrics["broken"].reason or "")
    assert result.metrics["l1"].mean is not None


@pytest.mark.parametrize("error", [SceneError("no"), NativeBuildError("no")], ids=["ours", "native"])
def test_an_error_for_the_user_ends_the_evaluation(monkeypatch: pytest.MonkeyPatch, error: Exception):
    def stops(render: torch.Tensor, truth: torch.Tensor) -> float:
        raise error

    monkeypatch.setattr(f"{IMAGE}.ssim", stops)
    with pytest.raises(type(error)):
        run(views(0, 1), stops=f"{IMAGE}:ssim")


def test_what_an_entry_declares_of_a_metric_is_typed_and_has_defaults():
    registry = Registry("metric")
    registry.add("a", "m:a", summary="", label="A", unit="dB", digits=2, direction="lower", whatever=1)
    registry.add("b", "m:b", summary="")
    a, b = (MetricInfo.of(entry) for entry in registry)
    assert (a.label, a.unit, a.digits, a.direction, a.group) == ("A", "dB", 2, "lower", "a")
    assert (b.label, b.unit, b.digits, b.direction, b.diagnostic) == ("b", "", 4, "higher", False)


def test_renders_are_kept_as_they_were_measured(tmp_path: Path):
    result = run(views(0, 9), background=0.25, save_to=tmp_path / "renders")
    assert result.renders == ["folder__0.png", "folder__1.png"]
    pixels = np.asarray(Image.open(tmp_path / "renders" / "folder__1.png"))
    assert pixels[0, 0].tolist() == [128, 64, 64]  # 127.5 rounds to even


def test_no_view_is_an_error():
    with pytest.raises(SceneError, match="no view"):
        run([])


def test_picture_names_stay_apart():
    assert png_names(["a.jpg", "b.c.jpg", "d/a.jpg"]) == ["a.png", "b.c.png", "d__a.png"]
    assert png_names(["a.jpg", "a.png", "x.jpg"]) == ["a.jpg.png", "a.png.png", "x.png"]
    for clashing in (["a/b.png", "a__b.png"], ["a.jpg", "a.png", "a.png.tif"], ["a", "a~2", "a"]):
        assert len(set(png_names(clashing))) == len(clashing)


def test_what_changes_the_picture_goes_into_the_file_and_comes_back():
    options = RasterOptions(antialias=True, eps2d=0.1, profile="gsplat", clamp_color=False)
    header = raster_header(options)
    assert header == {"antialias": True, "eps2d": 0.1, "profile": "gsplat", "clamp_color": False}
    assert raster_header(render_options(header, None)) == header
    assert raster_header(RasterOptions(background=torch.ones(3), alpha=True)) == {}


@pytest.mark.parametrize(
    "raster",
    [
        {"antialias": 1},
        {"antialias": "yes"},
        {"eps2d": -1},
        {"eps2d": math.inf},
        {"eps2d": True},
        {"profile": None},
        {"profile": "x" * 65},
    ],
)
def test_a_file_that_asks_for_nonsense_is_refused(raster: dict[str, object]):
    with pytest.raises(BitstreamError, match="which makes no sense"):
        render_options(raster, None)


def test_what_a_file_says_to_its_method_does_not_disturb():
    assert raster_header(render_options({"sh_degree": 3, "eps2d": 1}, None)) == {"eps2d": 1.0}


def test_a_file_may_suggest_rasterizers_by_name():
    assert suggested_rasterizers({}) == ()
    assert suggested_rasterizers({"prefer": ["flash", "standard"]}) == ("flash", "standard")


@pytest.mark.parametrize("prefer", ["flash", [1], ["x"] * 17, ["x" * 65], {"flash": 1}, None])
def test_suggestions_that_are_no_short_list_of_names_are_refused(prefer):
    with pytest.raises(BitstreamError, match="prefers the rasterizers"):
        suggested_rasterizers({"prefer": prefer})
