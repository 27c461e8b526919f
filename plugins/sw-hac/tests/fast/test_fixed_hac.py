"""A training step of HAC in tensors of fixed sizes, as a GPU replays it, equals that on any number of anchors."""

import copy
from contextlib import nullcontext

import pytest
import torch
from hac_models import make
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED, CodedAnchors
from sw_anchors.fast import replay
from sw_anchors.fast.fixed_step import FixedRows, sample_capacity, sample_of
from sw_anchors.fast.replay import FixedDecoder
from sw_anchors.fast.seen_rows import AnchorOrder, ExpectedRows, SeenRows, capacity_of
from sw_anchors.testing import check_plain, check_replayed
from sw_reference.testing.raster_scenes import front_camera

from sw_hac.model import HACAnchors

N = 330


def trained(device="cpu"):
    model = make(N).to(device)
    with torch.no_grad():
        for parameter in model.mlp_opacity.parameters():
            parameter.mul_(3)  # opacities of both signs
    return model.requires_grad_(True)


def replayed(model, graphs=False):
    """Let the steps of a model be replayed, on any device."""
    fixed = replay.DECODERS[model] = FixedDecoder(graphs=graphs)
    return fixed


def decoded(model, rows, camera=None):
    """The Gaussians of the anchors `rows`, replayed where a training step is."""
    camera = camera or front_camera().to(model.device)
    if not replay.fits(model, CodedAnchors):
        return model.decode(camera, rows)
    found = replay.DECODERS[model].decode(model, camera, SeenRows(rows))
    return model.decode(camera, rows) if found is None else found


def test_the_fast_forms_change_neither_values_nor_gradients():
    check_plain(trained, front_camera(), counts=(0, 1, 120, N))


def test_fixed_sizes_change_neither_values_nor_gradients():
    check_replayed(trained, front_camera(), counts=(0, 1, 120, 255, N))


def test_without_a_kernel_for_the_grid_it_is_the_same(monkeypatch):
    monkeypatch.setattr("sw_hac.fast.sign_lookup.fits", lambda *_: False)
    check_replayed(trained, front_camera(), counts=(90,), phases=(ENTROPY,))


def test_what_stood_beyond_the_count_does_not_matter():
    model = trained().train()
    fixed, model.phase = replayed(model), FULL
    images = []
    for before in (200, 3):
        decoded(model, torch.arange(before))
        fixed._steps[256, 0].at.positions[100:].copy_(front_camera().center)  # where no direction is
        found = decoded(model, torch.arange(50, 90))
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
    fixed = replayed(model)
    model.phase = QUANTIZED

    def captures(count):
        assert decoded(model, torch.arange(count)) is not None
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


class Seen:
    """Stands in for a rasterizer whose visibility test lets the anchors `rows` through."""

    def __init__(self, rows):
        self.rows = rows

    def visible_filter(self, balls, camera):
        radii = torch.zeros(len(balls), dtype=torch.int32, device=balls.means.device)
        return radii.index_fill_(0, torch.tensor(self.rows, dtype=torch.int64, device=radii.device), 1)


def gradients_of(model, camera, rows):
    model.zero_grad()
    found = model.gaussians(camera, Seen(rows))
    chosen = found.extras["anchors"].rows
    assert sorted(chosen.tolist()) == sorted(rows)
    owner = chosen[found.extras["anchors"].drawn // model.num_offsets]  # rows may stand in another order
    total = sum((t.flatten(1) * (1 + owner[:, None] % 7)).sum() for t in (found.means, found.scales, found.colors))
    (total + (found.opacities * (1 + owner % 5)).sum()).backward()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def check_views_that_come_again(device, graphs):
    camera, model = front_camera().to(device), trained(device).train()
    plain = trained(device).train()
    model.phase = plain.phase = FULL  # without noise, whose draws depend on the places
    fixed = replayed(model, graphs)
    asked = []
    made = fixed.expected
    fixed.expected = lambda *args: asked.append(made(*args)) or asked[-1]
    # First seen; as before; a few more; far more than expected; few; none; all after none.
    for rows in (range(100), range(100), range(5, 120), range(330), range(40, 52), (), range(330)):
        expected, got = gradients_of(plain, camera, list(rows)), gradients_of(model, camera, list(rows))
        for name in expected.keys() | got.keys():
            torch.testing.assert_close(*(each.get(name, torch.zeros((), device=device)).expand_as(got[name])
                                         for each in (expected, got)), rtol=1e-4, atol=1e-5)  # fmt: skip
    assert asked == [None, 256, 256, 256, 384, 256, 256]


def test_a_view_that_comes_again_is_decoded_before_its_anchors_are_counted():
    check_views_that_come_again("cpu", graphs=False)


@pytest.mark.parametrize("seen", [100, 300])
def test_a_view_that_comes_again_is_decoded_though_graphs_are_refused_by_then(seen, monkeypatch):
    """300 anchors have no place in what 100 let expect."""

    def refuse(*_):
        raise RuntimeError("out of memory")

    model, camera = trained().train(), front_camera()
    model.phase, fixed = FULL, replayed(model)
    model.gaussians(camera, Seen(range(100)))
    fixed._drop()
    monkeypatch.setattr("sw_anchors.fast.replay.PlainStep", refuse)
    assert fixed.expected(camera, N) == 256
    assert sorted(model.gaussians(camera, Seen(range(seen))).extras["anchors"].rows.tolist()) == list(range(seen))
    assert fixed.expected(camera, N) is None


@pytest.mark.parametrize("name", ["visible_anchors", "decode"])
def test_what_a_subclass_has_of_its_own_is_asked_for_views_that_come_again_too(name):
    asked = []

    def own(self, *given):
        asked.append(given)
        return getattr(HACAnchors, name)(self, *given)

    model, camera = trained().train(), front_camera()
    model.__class__ = type("Own", (HACAnchors,), {name: own})
    replayed(model)
    for _ in range(2):
        assert model.gaussians(camera, Seen(range(100))).extras["anchors"].rows.tolist() == list(range(100))
    assert len(asked) == 2


def test_anchors_are_expected_in_proportion_to_how_many_there_are():
    model, camera = trained().train(), front_camera()
    fixed = replayed(model)
    assert fixed.expected(camera, 1000) is None
    decoded(model, torch.arange(300), camera)
    assert fixed.expected(camera, N) == capacity_of(312)
    assert fixed.expected(camera, 2 * N) == capacity_of(624)
    assert fixed.expected(front_camera(), N) is None  # another camera, though it stands there too


def test_no_more_places_are_asked_for_than_all_anchors_need():
    model, camera = trained().train(), front_camera()
    fixed = replayed(model)
    decoded(model, torch.arange(N), camera)
    assert capacity_of(1030) > capacity_of(1000)
    assert fixed.expected(camera, 1000) == capacity_of(1000)


def test_a_model_without_anchors_is_decoded_and_may_grow_again():
    model, camera = trained().train(), front_camera()
    model.phase = FULL
    replayed(model)
    rows = {name: getattr(model, name) for name in model.ROWS}
    model.gaussians(camera, Seen(range(10)))

    def take(count):
        for name, tensor in rows.items():
            part = tensor.detach()[:count].clone()
            setattr(model, name, torch.nn.Parameter(part) if isinstance(tensor, torch.nn.Parameter) else part)

    take(0)
    for _ in range(2):
        assert len(model.gaussians(camera, Seen([])).means) == 0
    take(40)
    for _ in range(2):
        assert sorted(model.gaussians(camera, Seen([3, 9])).extras["anchors"].rows.tolist()) == [3, 9]


@pytest.mark.parametrize("seen", [0, 1, 9, 10, 11, 50])
def test_rows_beyond_the_places_are_left_out_and_told(seen):
    order = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(50, dtype=torch.bool)
    mask[torch.randperm(50, generator=torch.Generator().manual_seed(1))[:seen]] = True
    rows, count = ExpectedRows(AnchorOrder(order), mask, 10), torch.zeros(())
    rows.write_number(count)
    assert rows.number() == int(count) == seen
    assert rows.loaded.tolist() == (order[mask].tolist() + [0] * 10)[:10]
    assert torch.equal(rows.placed(), order[mask][:10])
    assert torch.equal(rows.known(), order[mask])
    assert rows.fit() == (seen < 10)


@pytest.mark.parametrize("seen", [0, 1, 255, 256])
def test_rows_that_are_known_and_those_that_are_found_answer_alike(seen):
    mask = torch.zeros(400, dtype=torch.bool)
    mask[torch.randperm(400, generator=torch.Generator().manual_seed(1))[:seen]] = True
    wanted, count = torch.nonzero(mask).squeeze(1), torch.zeros(())
    known = SeenRows(wanted)
    for rows in (known, ExpectedRows(AnchorOrder(torch.arange(400)), mask, known.capacity)):
        assert rows.capacity == capacity_of(seen)
        assert torch.equal(rows.known(), wanted)
        assert torch.equal(rows.placed(), wanted)
        assert torch.equal(rows.loaded[:seen], wanted)
        assert rows.fit()
        rows.write_number(count.fill_(-1))
        assert count == seen


def test_random_draws_are_centred_and_new_at_each_step():
    model = trained().train()
    fixed = replayed(model)
    model.phase = QUANTIZED
    seen = []
    for _ in range(2):
        decoded(model, torch.arange(100))
        at: FixedRows = fixed._steps[256, 0].at
        seen.append(at.random.clone())
        assert float(at.random.abs().max()) <= 0.5
        assert abs(float(at.random.mean())) < 0.02
    assert not torch.equal(*seen)


def test_a_copy_and_evaluation_leave_the_fixed_sizes_alone():
    model = trained().train()
    fixed = replayed(model)
    assert copy.deepcopy(model) not in replay.DECODERS
    model.eval().decode(front_camera(), torch.arange(10))
    with torch.no_grad():
        model.train().decode(front_camera(), torch.arange(10))
    assert fixed.captures == 0


@pytest.mark.parametrize("kind", [RuntimeError, torch.cuda.OutOfMemoryError])
def test_a_gpu_that_refuses_graphs_is_named_once_and_training_goes_on(kind, monkeypatch, caplog):
    def refuse(*_):
        raise kind("operation not permitted\nand more")

    monkeypatch.setattr("sw_anchors.fast.replay.CapturedStep", refuse)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    model = trained().train()
    fixed, model.sample = replayed(model, graphs=True), 1.0
    for _ in range(2):
        found = decoded(model, torch.arange(30))
        assert found.extras["rate"].bits.requires_grad
    assert caplog.messages == ["training goes on without CUDA graphs, slower: operation not permitted"]
    assert fixed._rows_held("positions") == 0


@pytest.mark.cuda
def test_graphs_change_neither_values_nor_gradients():
    camera = front_camera().to("cuda")
    check_replayed(lambda: trained("cuda"), camera, counts=(0, 1, 120, 255, 256, 50, N), graphs=True)


@pytest.mark.cuda
def test_graphs_are_made_anew_when_networks_or_phase_change():
    model = trained("cuda").train()
    fixed = replayed(model, graphs=True)
    rows = torch.arange(100, device="cuda")
    model.phase = ENTROPY
    first = decoded(model, rows).extras["rate"].own_bits.item()
    assert decoded(model, rows[:50]).extras["rate"].own_bits.item() == first
    assert fixed.captures == 1
    with torch.no_grad():
        model.grid.grids[0].table = torch.nn.Parameter(-model.grid.grids[0].table.abs())
    assert decoded(model, rows).extras["rate"].own_bits.item() != first
    assert fixed.captures == 2
    model.phase = QUANTIZED
    assert "rate" not in decoded(model, rows).extras
    assert (fixed.captures, fixed._failed) == (3, False)


@pytest.mark.cuda
def test_graphs_of_a_view_that_comes_again_wait_for_no_count():
    check_views_that_come_again("cuda", graphs=True)
    order, seen = AnchorOrder(torch.arange(1000, device="cuda")), torch.arange(1000, device="cuda") % 3 == 0
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        rows = ExpectedRows(order, seen, 512)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert rows.number() == 334
    assert rows.loaded[:334].tolist() == list(range(0, 1000, 3))


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a GPU that is not the current one")
def test_the_count_is_waited_for_on_the_device_of_the_anchors():
    order = AnchorOrder(torch.arange(1000, device="cuda:1"))
    ExpectedRows(order, order.rows < 5, 512).number()  # memory of the host is set aside before
    with torch.cuda.device(1):
        torch.cuda._sleep(1_000_000_000)
    assert ExpectedRows(order, order.rows % 3 == 0, 512).number() == 334
