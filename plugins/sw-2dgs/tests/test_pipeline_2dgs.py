"""2DGS on the small procedural scene: it learns, resumes, and its file holds what it learned."""

import pytest
import torch
from sw_gaussians.surfels import Surface, SurfelModel
from sw_kit import short_training
from sw_kit.short_training import demo, file_of, psnr

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import stream
from splatwizard_core.training.pipeline import TrainingStopped
from sw_2dgs.config import TwoDGSConfig
from sw_2dgs.method import TwoDGS

pytestmark = pytest.mark.pipeline

STEPS = 120
PLAN = {
    "iterations": STEPS,
    "lr.max_steps": STEPS,
    "sh_interval": 30,
    "densify.start": 30,
    "densify.stop": 90,
    "densify.interval": 20,
    "densify.reset_interval": 200,
    "surface.dist_after": 40,
    "surface.normal_after": 60,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return demo()


@pytest.fixture(scope="module")
def rasterizer() -> NegotiatedRasterizer:
    return NegotiatedRasterizer(load_plugins(), device="cpu")


def method(**values) -> TwoDGS:
    values = {key.replace("__", "."): value for key, value in values.items()}
    return TwoDGS(load_plugins(), apply_overrides(TwoDGSConfig(), {**PLAN, **values}, source="test"))


def train(scene, rasterizer, directory=None, stop_after=None, **values):
    return short_training.train(method(**values), scene, rasterizer, directory=directory, stop_after=stop_after)


@torch.no_grad()
def drawn(model, camera, rasterizer, **options) -> torch.Tensor:
    return rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions(**options))


@pytest.fixture(scope="module")
def trained(scene, rasterizer):
    return train(scene, rasterizer).model


def test_training_learns_the_scene(scene, rasterizer, trained):
    start = method().create_model(scene, stream(0, "init"))
    assert psnr(trained, scene, rasterizer) > psnr(start, scene, rasterizer) + 4
    assert isinstance(trained, SurfelModel)
    assert trained.surface == Surface(1.0, 100.0, 0.05)
    assert trained.num_rows != start.num_rows  # densified and pruned


def test_stopped_and_resumed_equals_one_go(scene, rasterizer, trained, tmp_path):
    for stop in (35, 61):  # before a densification, and where the normals have just begun
        with pytest.raises(TrainingStopped):
            train(scene, rasterizer, directory=tmp_path, stop_after=stop)
    resumed = train(scene, rasterizer, directory=tmp_path).model
    assert resumed.digest() == trained.digest()
    assert resumed.surface == trained.surface


def encoded(model, rate: str) -> bytes:
    values = {key.replace(".", "__"): value for key, value in TwoDGS.RATES[rate].items()}
    return file_of(method(**values), model)


def decoded(data: bytes) -> SurfelModel:
    return TwoDGS(load_plugins(), None).decode(ContainerReader(data, "file.swz"))


def test_the_exact_file_draws_the_same_pixels_and_maps(scene, rasterizer, trained):
    found, camera = decoded(encoded(trained, "r6")), scene.test[0].camera
    maps = {"depth": frozenset({"median", "expected"}), "normals": True, "distortion": True}
    ours, theirs = (drawn(each, camera, rasterizer, **maps) for each in (found, trained))
    assert torch.equal(ours.image, theirs.image)
    assert torch.equal(ours.normals, theirs.normals)
    assert torch.equal(ours.depth["median"], theirs.depth["median"])
    assert found.surface == trained.surface


def test_quantised_files_trade_bytes_for_quality(scene, rasterizer, trained):
    files = {rate: encoded(trained, rate) for rate in ("r1", "r4", "r6")}
    quality = {rate: psnr(decoded(data), scene, rasterizer) for rate, data in files.items()}
    assert len(files["r1"]) < len(files["r4"]) < len(files["r6"]) / 5
    assert quality["r1"] < quality["r4"]
    assert quality["r4"] > quality["r6"] - 0.5


def test_the_header_says_how_the_surface_was_trained(trained):
    header = ContainerReader(encoded(trained, "r3"), "file.swz").static
    assert header["primitive"] == "surfel"
    assert header["depth_ratio"] == 1.0
    assert (header["lambda_dist"], header["lambda_normal"]) == (100.0, 0.05)


@pytest.mark.parametrize("rate", ["r3", "r6"])
def test_a_damaged_file_is_a_bitstream_error(trained, rate):
    data = encoded(trained, rate)
    for at in range(10, len(data), len(data) // 12):
        with pytest.raises(BitstreamError):
            decoded(data[:at])
        flipped = bytearray(data)
        flipped[at] ^= 0x10
        with pytest.raises(BitstreamError):
            decoded(bytes(flipped))
