"""A training step of HAC in tensors of fixed sizes, as a GPU replays it, equals that on any number of anchors."""

import copy
from contextlib import nullcontext

import pytest
import torch
from hac_models import PLUGINS, make
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED
from sw_anchors.fixed_decoder import FixedDecoder, capacity_of
from sw_anchors.fixed_step import FixedRows, sample_capacity, sample_of
from sw_anchors.testing import check_fixed_decoder
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.rendering.negotiation import NegotiatedRasterizer

RASTERIZER = NegotiatedRasterizer(PLUGINS, device="cpu")
N = 330


def trained(device="cpu"):
    model = make(N).to(device)
    with torch.no_grad():
        for parameter in model.mlp_opacity.parameters():
            parameter.mul_(3)  # opacities of both signs
    return model.requires_grad_(True)


def test_fixed_sizes_change_neither_values_nor_gradients():
    check_fixed_decoder(trained, front_camera(), RASTERIZER, counts=(0, 1, 120, 255, N))


@pytest.mark.parametrize("kept", [True, False])
def test_without_a_kernel_for_the_grid_it_is_the_same(kept, monkeypatch):
    monkeypatch.setattr("sw_codecs.context.hash_grid.signs_fit_kernel", lambda *_: False)
    monkeypatch.setattr("sw_anchors.grid_anchors.PLACES_LIMIT", 1 << 30 if kept else 0)
    assert len(trained().context_rows()) == (4 if kept else 1)
    check_fixed_decoder(trained, front_camera(), RASTERIZER, counts=(90,), phases=(ENTROPY,))


def test_what_stood_beyond_the_count_does_not_matter():
    model = trained().train()
    model.fixed, model.phase = FixedDecoder(graphs=False), FULL
    images = []
    for before in (200, 3):
        model.decode(front_camera(), torch.arange(before))
        model.fixed._steps[256, 0].at.positions[100:].copy_(front_camera().center)  # where no direction is
        found = model.decode(front_camera(), torch.arange(50, 90))
        found.means.sum().backward()
        images.append([found.opacities.detach().clone(), model.mlp_opacity[0].weight.grad.clone()])
        assert int(found.extras["anchors"].drawn.max()) < 40 * model.num_offsets
        model.zero_grad()
    assert all(bool(torch.isfinite(each).all()) for both in images for each in both)
    torch.testing.assert_close(*images)


def test_capacities_are_more_than_the_count_and_few():
    assert all(count < capacity_of(count) <= max(256, 1.25 * count + 1) for count in range(5000))
    assert len({capacity_of(count) for count in range(65_536)}) <= 34


@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_a_sample_holds_the_rows_that_were_drawn(share):
    draws = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    valid = (torch.arange(1000) < 900).float()
    rows, is_drawn = sample_of(draws, valid, share)
    assert len(rows) == sample_capacity(1000, share)
    wanted = torch.nonzero(draws[:900] < share).squeeze(1)
    assert rows[is_drawn > 0].tolist() == wanted.tolist()
    assert bool((rows[is_drawn == 0] == 999).all())


def test_more_drawn_than_a_sample_holds_are_left_out():
    rows, is_drawn = sample_of(torch.zeros(1000), (torch.arange(1000) < 999).float(), 0.01)
    assert rows.tolist() == list(range(sample_capacity(1000, 0.01)))
    assert bool((is_drawn == 1).all())


def test_steps_are_prepared_once_for_a_capacity_and_anew_when_networks_or_phase_change():
    model = trained().train()
    fixed = model.fixed = FixedDecoder(graphs=False)
    model.phase = QUANTIZED

    def captures(count):
        assert model.decode(front_camera(), torch.arange(count)) is not None
        return fixed.captures

    assert [captures(10), captures(200), captures(255)] == [1, 1, 1]
    assert [captures(256), captures(300), captures(10)] == [2, 2, 3]  # more memory than before: all anew
    model.features = torch.nn.Parameter(model.features.detach().clone())  # as growth does
    assert captures(11) == 3
    model.phase = ENTROPY
    assert captures(11) == 4
    model.mlp_grid[0].weight = torch.nn.Parameter(model.mlp_grid[0].weight.detach().clone())
    assert captures(11) == 5
    model.mlp_color.requires_grad_(False)
    assert captures(11) == 6


def test_random_draws_are_centred_and_new_at_each_step():
    model = trained().train()
    model.fixed = FixedDecoder(graphs=False)
    model.phase = QUANTIZED
    seen = []
    for _ in range(2):
        model.decode(front_camera(), torch.arange(100))
        at: FixedRows = model.fixed._steps[256, 0].at
        seen.append(at.random.clone())
        assert float(at.random.abs().max()) <= 0.5
        assert abs(float(at.random.mean())) < 0.02
    assert not torch.equal(*seen)


def test_a_copy_and_evaluation_leave_the_fixed_sizes_alone():
    model = trained().train()
    fixed = model.fixed = FixedDecoder(graphs=False)
    assert copy.deepcopy(model).fixed is None
    model.eval().decode(front_camera(), torch.arange(10))
    with torch.no_grad():
        model.train().decode(front_camera(), torch.arange(10))
    assert fixed.captures == 0


@pytest.mark.parametrize("kind", [RuntimeError, torch.cuda.OutOfMemoryError])
def test_a_gpu_that_refuses_graphs_is_named_once_and_training_goes_on(kind, monkeypatch, caplog):
    def refuse(*_):
        raise kind("operation not permitted\nand more")

    monkeypatch.setattr("sw_anchors.fixed_decoder.CapturedStep", refuse)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    model = trained().train()
    model.fixed, model.sample = FixedDecoder(), 1.0
    for _ in range(2):
        found = model.decode(front_camera(), torch.arange(30))
        assert found.extras["rate"].bits.requires_grad
    assert caplog.messages == ["training goes on without CUDA graphs, slower: operation not permitted"]
    assert model.fixed._rows_held("positions") == 0


@pytest.fixture(scope="module")
def gpu():
    return NegotiatedRasterizer(PLUGINS, device="cuda")


@pytest.mark.cuda
def test_graphs_change_neither_values_nor_gradients(gpu):
    camera = front_camera().to("cuda")
    check_fixed_decoder(lambda: trained("cuda"), camera, gpu, counts=(0, 1, 120, 255, 256, 50, N), graphs=True)


@pytest.mark.cuda
def test_graphs_are_made_anew_when_networks_or_phase_change(gpu):
    camera, model = front_camera().to("cuda"), trained("cuda").train()
    fixed = model.fixed = FixedDecoder()
    rows = torch.arange(100, device="cuda")
    model.phase = ENTROPY
    first = model.decode(camera, rows).extras["rate"].own_bits.item()
    assert model.decode(camera, rows[:50]).extras["rate"].own_bits.item() == first
    assert fixed.captures == 1
    with torch.no_grad():
        model.grid.grids[0].table = torch.nn.Parameter(-model.grid.grids[0].table.abs())
    assert model.decode(camera, rows).extras["rate"].own_bits.item() != first
    assert fixed.captures == 2
    model.phase = QUANTIZED
    assert "rate" not in model.decode(camera, rows).extras
    assert (fixed.captures, fixed._failed) == (3, False)
