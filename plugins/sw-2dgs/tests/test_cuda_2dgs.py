"""A training step of 2DGS on a GPU gives the loss and the gradients of the CPU."""

import pytest
import torch
from sw_gaussians.start import surfels_from_points

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from sw_2dgs.config import TwoDGSConfig
from sw_2dgs.stage import TwoDGSStage

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]


def step_on(device: str) -> tuple[dict[str, float], torch.Tensor]:
    """(parts of the loss, gradient of the means) of one step with both losses."""
    scene = load_scene("demo:tiny", SceneOptions(init_points=600), load_plugins())
    values = {"surface.dist_after": 0, "surface.normal_after": 0}
    stage = TwoDGSStage(apply_overrides(TwoDGSConfig(), values, source="test"))
    model = surfels_from_points(scene.points, generator=torch.Generator().manual_seed(0)).to(device)
    rasterizer, view = NegotiatedRasterizer(load_plugins(), device=device), scene.train[0]
    background, camera = scene.background.to(device), view.camera.to(device)
    result = rasterizer.render(model.gaussians(camera, rasterizer), camera, stage.raster_options(1, background))
    pack = stage.loss(model, view, result, background, 1)
    pack.total.backward()
    return {name: float(part) for name, part in pack.parts.items()}, model.means.grad.cpu()


def test_a_step_is_that_of_the_cpu():
    parts, gradient = step_on("cpu")
    there, moved = step_on("cuda")
    assert there == pytest.approx(parts, rel=1e-3, abs=1e-6)
    assert torch.allclose(moved, gradient, atol=1e-2 * float(gradient.abs().max()))
