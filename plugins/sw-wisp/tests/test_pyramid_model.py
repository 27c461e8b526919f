"""pyramid as a context model: the contract, that a splat tells those behind it alone, and bits as in a file."""

import functools

import pytest
import torch
from wisp_scenes import made_up

from splatwizard_core.api import ContainerReader, ContainerWriter
from sw_codecs import testing
from sw_wisp import file
from sw_wisp.numbers import BASE_STEPS, LATENTS, NUMBERS
from sw_wisp.octree import file_order, position_bits
from sw_wisp.pyramid_model import PyramidModel
from sw_wisp.rate import bits, sigma_of

STEPS = torch.tensor(BASE_STEPS)
SCENE = made_up(2_000)


@functools.cache
def fitted() -> PyramidModel:
    """Networks that know the scene; made within a test, which has one thread."""
    return PyramidModel.fitted(SCENE.levels, SCENE.cells, SCENE.values, STEPS, updates=40, batch=256)


def test_it_keeps_the_contract(plugins):
    assert plugins.context_models.load("pyramid") is PyramidModel
    for each in (PyramidModel(), fitted()):
        testing.check_context_model(each, SCENE.levels, SCENE.cells, SCENE.values.float())


def test_its_networks_learn():
    mean, scale, steps = fitted()(SCENE.levels[:200], SCENE.cells[:200], SCENE.values[:200].float())
    assert mean.shape == scale.shape == steps.shape == (200, NUMBERS)
    bits(SCENE.values[:200] - mean, sigma_of(scale, steps), steps).sum().backward()
    assert all(float(weight.grad.abs().sum()) > 0 for weight in fitted().networks.networks.parameters())


@torch.no_grad()
def test_a_splat_tells_those_behind_it_alone():
    levels, cells = SCENE.levels[:200], SCENE.cells[:200]
    order = file_order(levels.numpy(), cells.numpy(), levels.numpy() * 0)
    before = fitted()(levels, cells, SCENE.values[:200].float())[0]
    for place, tells in ((0, True), (1, False)):  # of the first part of the packets, and of the last
        values = SCENE.values[:200].float()
        values[order[place], LATENTS.columns] += 1.0
        after = fitted()(levels, cells, values)[0]
        others = torch.arange(200) != int(order[place])
        assert torch.equal(before[others], after[others]) != tells


def test_estimated_bits_are_those_of_the_file():
    """Of each packet within 2 %: the octree and all numbers but latents, and latents."""
    writer = ContainerWriter("wisp", 1)
    found = file.encode(
        file.Scene(SCENE.cube, SCENE.levels, SCENE.cells, SCENE.values, (), context=fitted().exact()), writer
    )
    sections = ContainerReader(writer.to_bytes()).sections
    rows, cells = torch.from_numpy(found.rows), found.decoded.state.cells
    written = found.decoded.values()
    with torch.no_grad():
        mean, scale, steps = fitted()(SCENE.levels[rows], SCENE.cells[rows], written)
        each = bits(written - mean, sigma_of(scale, steps), steps).double().sum(0)
    base = float(each[:10].sum()) + position_bits(cells).sum()
    assert base == pytest.approx(8 * sections["packet.01"], rel=0.02)
    assert float(each[10:].sum()) == pytest.approx(8 * sections["packet.02"], rel=0.02)
