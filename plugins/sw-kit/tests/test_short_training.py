"""The short training that pipeline tests share; the methods' own tests hold what it trains."""

from types import SimpleNamespace

import pytest
import torch
from sw_kit.short_training import file_of, nothing_trained, psnr, train

from splatwizard_core.api import ContainerReader


def writes(name, change):
    """A method whose encode adds `change` to the means."""

    def encode(model, writer):
        model.means += change
        writer.add_array("means", model.means.numpy())

    return SimpleNamespace(name=name, version=3, encode=encode)


def test_a_file_is_that_of_the_method(sw_gaussians):
    reader = ContainerReader(file_of(writes("plain", 0.0), sw_gaussians), "file.swz")
    assert (reader.method, reader.version, list(reader.sections)) == ("plain", 3, ["means"])


def test_an_encoder_that_changes_the_model_is_caught(sw_gaussians):
    with pytest.raises(AssertionError, match="encode changes the model"):
        file_of(writes("rude", 1.0), sw_gaussians)


def test_a_method_that_asks_for_a_trained_scene_must_be_given_one():
    with pytest.raises(AssertionError, match="trained by '3dgs'"):
        nothing_trained("3dgs")


def test_an_empty_list_of_stages_does_not_train_those_of_the_method(sw_scene):
    with pytest.raises(ValueError, match="at least one stage"):
        train(SimpleNamespace(stages=lambda: pytest.fail("asked for its stages")), sw_scene, None, stages=[])


def test_black_pictures_have_the_psnr_of_the_photographs_own_energy(sw_scene):
    nothing = SimpleNamespace(gaussians=lambda camera, rasterizer: None)
    black = torch.zeros(3, sw_scene.train[0].camera.height, sw_scene.train[0].camera.width)
    draws = SimpleNamespace(render=lambda gaussians, camera, options: SimpleNamespace(image=black))
    energies = [view.image(sw_scene.background).pow(2).mean() for view in sw_scene.train]
    expected = sum(-10 * float(energy.log10()) for energy in energies) / len(energies)
    assert psnr(nothing, sw_scene, draws) == pytest.approx(expected, rel=1e-5)
