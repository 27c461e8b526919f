"""Trained Gaussians in a file of a size, by the codec that methods name."""

from pathlib import Path
from typing import Any

import pytest
import torch
from sw_compress.sized import Sized

from splatwizard_core.api import (
    Camera,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    Method,
    UserInputError,
    create_method,
)
from splatwizard_core.tooling import encode, load_plugins, open_model

pytestmark = pytest.mark.pipeline


def sized(method: str, size: str, scene: Any = None) -> Method:
    found = create_method(load_plugins(), method, {"size": size})
    found.scene = scene
    return found


@pytest.fixture(scope="module")
def model(ball) -> GaussianModel:
    return ball(300)


class Around:
    """A scene whose training views look at the ball from one side."""

    name, origin = "ball", (1.0, 2.0, 3.0)

    def __init__(self) -> None:
        up = torch.tensor([0.0, -1.0, 0.0])
        self.train = [
            type("View", (), {"camera": Camera.look_at(
                torch.tensor([0.2 * i - 0.8, 0.3, -3.0]), torch.zeros(3), up, width=48, height=48, fov_x=0.8
            )})
            for i in range(8)
        ]  # fmt: skip


@pytest.mark.parametrize("method", ["3dgs", "pup-3dgs"])
def test_the_file_of_a_training_fills_its_size(model, tmp_path: Path, method: str):
    out, scene = tmp_path / "a.swz", Around()
    facts = encode(sized(method, "5kB", scene), model, {"sh_degree": 2}, out, scene.origin)
    assert 0.99 * 5_000 < facts.bytes == out.stat().st_size <= 5_000
    decoded, reader = open_model(out, load_plugins(), torch.device("cpu"))
    assert (reader.method, tuple(reader.world_origin)) == (method, scene.origin)
    assert decoded.num_rows <= 300
    told = {name for requirement in reader.requires for _, name in requirement.provided}
    assert "gaussians-quantized" in told
    assert "gaussians-sized" not in told  # it is not needed to read the file


def test_training_views_say_what_may_go(ball):
    """Gaussians that training views do not show go first: these prove more than cameras that are made up."""
    model = ball(300)
    model.means[:100, 0] += 50.0
    found, codec = Sized(load_plugins(), size="2700").chosen(model, "3dgs", {}, Around())
    assert codec.name == "gaussians-quantized"
    assert found.num_rows < 250
    assert (found.means[:, 0] < 25).all()


def test_the_model_stays_as_it_is(model):
    before = model.digest()
    Sized(load_plugins(), size="3kB").chosen(model, "3dgs", {}, Around())
    assert model.digest() == before


def test_without_a_size_it_is_the_codec_that_it_writes_with(model):
    writers = [ContainerWriter("3dgs", 1) for _ in range(2)]
    Sized(load_plugins()).encode(model, writers[0])
    load_plugins().gaussian_codecs.load("gaussians-quantized")(load_plugins()).encode(model, writers[1])
    assert writers[0].to_bytes() == writers[1].to_bytes()
    decoded = Sized(load_plugins()).decode(ContainerReader(writers[0].to_bytes()))
    assert decoded.num_rows >= 295  # but for what is never drawn


def test_a_size_out_of_reach_is_told(ball, tmp_path: Path):
    with pytest.raises(UserInputError, match="size=200: header and sections of a file alone have"):
        encode(sized("3dgs", "200"), ball(30), {}, tmp_path / "a.swz")
    assert list(tmp_path.iterdir()) == []
