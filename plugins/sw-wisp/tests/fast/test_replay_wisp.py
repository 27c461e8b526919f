"""Splats of a training step in tensors that stay where they are, as a GPU replays them, equal those of a plain step."""

from contextlib import nullcontext

import pytest
import torch
from sw_gaussians.fast.graphs import PlainStep
from sw_kit import short_training
from wisp_scenes import made_up

from splatwizard_core.runs.config import apply_overrides
from sw_wisp.appearance import AppearanceNetwork
from sw_wisp.config import WispConfig
from sw_wisp.fast import replay
from sw_wisp.fast.replay import FixedSplats
from sw_wisp.layers import Layers
from sw_wisp.method import Wisp
from sw_wisp.model import WispModel
from sw_wisp.numbers import GROUPS
from sw_wisp.rate_model import PyramidRate, StaticRate
from sw_wisp.rounding import FINAL, FLOAT, HARD, NOISE, SOFT

N = 120
SWITCHES = [
    {"phase": FLOAT}, {"phase": NOISE}, {"phase": NOISE, "counted": 0.3},
    {"phase": NOISE, "counted": 0.3, "jitters": True}, {"phase": SOFT, "sharpness": 2.5, "counted": 0.3},
    {"phase": SOFT, "sharpness": 7.0}, {"phase": HARD, "counted": 0.1}, {"phase": FLOAT, "counted": 0.3},
    {"phase": FINAL}, {"phase": HARD, "packets": 2}, {"phase": SOFT, "sharpness": 3.0, "packets": 1},
    {"phase": FINAL, "packets": 4},
]  # fmt: skip
"""Attributes of the model at steps of a training."""


def made(device="cpu", rate=PyramidRate):
    """A model whose networks say something of each splat."""
    scene, draws = made_up(N, spread=1.0), torch.Generator().manual_seed(0)
    opacity, shape, size, colour, latents = (scene.values[:, group.columns].float() for group in GROUPS)
    steps, network = torch.tensor(scene.base_steps), AppearanceNetwork(generator=draws)
    rate = rate(steps, adaptive=True, generator=draws) if rate is PyramidRate else rate(steps)
    means = scene.cube.centres(scene.levels, scene.cells)
    model = WispModel(
        means, opacity[:, 0], shape, size[:, 0], colour, latents, scene.levels,
        cube=scene.cube, network=network, rate=rate,
    )  # fmt: skip
    model.size.data.add_(model.log_edges(model.levels))
    model.subsets = torch.arange(N) % 2
    model.layers = Layers.of_subsets(2, 1)
    model.begin_rate()
    with torch.no_grad():
        for parameter in (*rate.parameters(), network.out.weight):
            parameter += 0.02 * torch.randn(parameter.shape, generator=draws)
    model.adapt()
    return model.to(device).train()


def replayed(model, graphs=False):
    """Let the steps of a model be replayed, on any device."""
    fixed = replay.STEPS[model] = FixedSplats(graphs=graphs)
    return fixed


def step(model, **switches):
    """Values that a step draws, and their gradients."""
    for name, value in {"counted": 0.0, "jitters": False, "packets": None, **switches}.items():
        setattr(model, name, value)
    torch.manual_seed(3)
    model.zero_grad()
    found = model.gaussians(None, None)
    results = [found.means, found.opacities, found.cov3d, found.sh.dc, found.sh.rest, *found.extras.values()]
    there = [] if found.visible is None else [found.visible.float()]
    loss = sum(
        (each * torch.linspace(0.5, 1, each.numel(), device=each.device).view_as(each)).sum() for each in results
    )
    loss.backward()
    grads = {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}
    return [each.detach().clone() for each in (*results, *there)], grads


@pytest.mark.parametrize("rounds", [False, True])
def test_a_step_is_the_plain_one_bit_for_bit(rounds):
    plain, model = made(), made()
    for each in (plain, model):
        each.network.rounds = each.rate.networks.rounds = rounds
    fixed = replayed(model)
    for switches in SWITCHES:
        expected, found = step(plain, **switches), step(model, **switches)
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
        assert len(expected[1]) >= 6 + 5 * (switches["phase"] in (NOISE, SOFT, HARD))
    assert fixed.captures == len(SWITCHES)


def test_without_kernels_it_is_the_same(monkeypatch):
    plain, model = made(), made()
    replayed(model)
    monkeypatch.setattr("sw_wisp.rate_model.fit_kernels", lambda *_: False)
    monkeypatch.setattr("sw_wisp.model.fit_kernels", lambda *_: False)
    for switches in SWITCHES:
        torch.testing.assert_close(step(model, **switches), step(plain, **switches), rtol=0, atol=0)


def check_what_is_made_anew(device, graphs):
    model = made(device)
    fixed = replayed(model, graphs)

    def captures(**switches):
        step(model, **switches)
        return fixed.captures

    assert [captures(phase=NOISE), captures(phase=NOISE)] == [1, 1]
    model.measure()  # writes features where they stand
    assert captures(phase=NOISE) == 1
    assert [captures(phase=SOFT, sharpness=s) for s in (1.0, 2.0, 8.0)] == [2, 2, 2]
    model.rate.networks.rounds = True
    assert captures(phase=SOFT) == 3
    model.opacity = torch.nn.Parameter(model.opacity.detach().clone())  # as removal does
    assert captures(phase=SOFT) == 4
    model.levels = model.levels + 1
    assert captures(phase=SOFT) == 5
    model.cube = type(model.cube)(model.cube.low, model.cube.edge * 2)
    assert captures(phase=SOFT) == 6
    assert [captures(phase=SOFT, packets=n) for n in (1, 3, None, 2)] == [7, 7, 7, 7]  # both are held
    model.eval().gaussians(None, None)
    with torch.no_grad():
        model.train().gaussians(None, None)
    assert (fixed.captures, fixed._failed) == (7, False)


def test_a_step_is_prepared_once_and_anew_when_a_switch_or_a_tensor_changes():
    check_what_is_made_anew("cpu", graphs=False)


def test_means_and_tables_by_level_are_not_replayed(monkeypatch):
    model = made(rate=StaticRate)
    fixed = replayed(model)
    step(model, phase=NOISE, counted=0.5)
    model = made()
    monkeypatch.setenv("SW_FAST", "0")
    fixed = replayed(model)
    step(model, phase=NOISE, counted=0.5)
    assert fixed.captures == 0


def test_bits_of_a_step_outlive_the_next_one():
    model = made()
    replayed(model)
    bits = []
    for seed in range(2):
        model.phase, model.counted = NOISE, 0.3
        torch.manual_seed(seed)
        bits.append(model.gaussians(None, None).extras["bits"].detach())
    assert bits[0] != bits[1]


def test_a_gpu_that_refuses_graphs_is_named_once_and_training_goes_on(monkeypatch, caplog):
    def refuse(*_):
        raise torch.cuda.OutOfMemoryError("no room\nand more")

    monkeypatch.setattr("sw_wisp.fast.replay.CapturedStep", refuse)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    plain, model = made(), made()
    fixed = replayed(model, graphs=True)
    for _ in range(2):
        switches = {"phase": NOISE, "counted": 0.3}
        torch.testing.assert_close(step(model, **switches), step(plain, **switches), rtol=0, atol=0)
    assert caplog.messages == ["training goes on without CUDA graphs, slower: no room"]
    assert fixed.captures == 1


def test_the_first_steps_of_a_training_are_the_plain_ones(plugins, toy, rasterizer, monkeypatch):
    values = {"iterations": 3, "context.fit": 0, "appearance.steps": "sensitivity"}
    method = Wisp(plugins, apply_overrides(WispConfig(), values, source="test").completed(plugins, {}))

    def trained():
        return short_training.train(
            method, toy.scene, rasterizer, model=lambda: None, trained={"3dgs": toy.truth}.__getitem__
        )

    plain, steps = trained(), []
    monkeypatch.setattr(replay, "fits", lambda model: model.training)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(replay, "CapturedStep", lambda *given: steps.append(PlainStep(*given[:2])) or steps[-1])
    found = trained()
    assert (found.losses, found.model.digest()) == (plain.losses, plain.model.digest())
    assert len(steps) == 1  # none for what is measured before the first step, whose gradients would stay


@pytest.mark.cuda
@pytest.mark.parametrize("rounds", [False, True])
def test_graphs_change_neither_values_nor_gradients(rounds, monkeypatch):
    plain, model = made("cuda"), made("cuda")
    for each in (plain, model):
        each.network.rounds = each.rate.networks.rounds = rounds
    fixed = replayed(model, graphs=True)
    for switches in SWITCHES:
        for _ in range(2):  # as captured, and again
            found = step(model, **switches)
            with monkeypatch.context() as patch:
                patch.setattr(replay, "fits", lambda _: False)
                expected = step(plain, **switches)
            for ours, theirs in zip(found[0], expected[0], strict=True):
                torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
            assert found[1].keys() == expected[1].keys()
            for name, theirs in expected[1].items():
                limit = 3e-4 * max(float(theirs.abs().max()), 1e-3)
                assert float((found[1][name] - theirs).abs().max()) <= limit, (switches, name)
    assert (fixed.captures, fixed._failed) == (len(SWITCHES), False)


@pytest.mark.cuda
def test_graphs_are_made_anew_when_a_switch_or_a_tensor_changes():
    check_what_is_made_anew("cuda", graphs=True)


@pytest.mark.cuda
def test_a_replayed_step_does_not_wait_for_the_device():
    model = made("cuda")
    fixed = replayed(model, graphs=True)
    step(model, phase=SOFT, counted=0.3)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = model.gaussians(None, None)
        (found.opacities.sum() + found.extras["bits"]).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert fixed.captures == 1
