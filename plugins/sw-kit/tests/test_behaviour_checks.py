"""Checks of behaviour can fail: on pruners, density controls, metrics and families that do not do what they must."""

from __future__ import annotations

import types

import pytest
import torch
from sw_kit.checks.behaviour import BEHAVIOUR
from sw_kit.checks.targets import check_target
from sw_kit.finding import BrokenContractError

from splatwizard_core.api import (
    DensityControl,
    MetricResult,
)
from splatwizard_core.tooling import load_plugins

PLUGINS = load_plugins()


class Pruner:
    uses_statistics = False

    def __init__(self):
        self.calls = 0

    def score(self, model, cameras, rasterizer, background=None):
        self.calls += 1
        return self.of(model, cameras)


class ChangesModel(Pruner):
    def of(self, model, cameras):
        model.means.data += 1
        return model.opacities.detach()


class ChangesGradients(Pruner):
    def of(self, model, cameras):
        model.means.sum().backward()
        return model.opacities.detach()


class Forgets(Pruner):
    def of(self, model, cameras):
        return model.opacities.detach() + self.calls


class ByFirstCamera(Pruner):
    def of(self, model, cameras):
        return (model.means.detach() - cameras[0].center).norm(dim=1)


class OneForAll(Pruner):
    def of(self, model, cameras):
        return model.opacities.mean()


@pytest.mark.parametrize(
    ("pruner", "said"),
    [(ChangesModel, "changes the model"), (ChangesGradients, "changes gradients"), (Forgets, "other scores"),
     (ByFirstCamera, "reverse order"), (OneForAll, "for 200 Gaussians")],
)  # fmt: skip
def test_pruners_that_do_more_than_score(entry_of, pruner, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["pruner"](entry_of("pruner", pruner), PLUGINS)


class Fading(DensityControl):
    """Fades the Gaussians, the more the more often it was asked, and says so in its checkpoints."""

    asked = 0

    @property
    def rounds(self):
        return range(3_000, 24_000, 3_000)

    def adjust(self, state):
        self.asked += 1
        state.optimizer.replace(state.model, "opacity_logits", state.model.opacity_logits - 0.1 * self.asked)
        return {"faded": state.model.num_rows}

    def state_dict(self):
        return {"asked": self.asked}

    def load_state_dict(self, state):
        self.asked = state["asked"]


class FadingForgets(Fading):
    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        """It has nothing to restore."""


class FadingAsks(Fading):
    def needs(self, step):
        return frozenset({"grad2d", "gradients"})


class FadingLeaves(Fading):
    def begin(self, state):
        state.model.register_buffer("votes", torch.zeros(state.model.num_rows))
        state.model.ROWS = (*state.model.ROWS, "votes")


class FadingNeverAsked(Fading):
    rounds = None


def test_a_control_that_keeps_its_state_passes(entry_of):
    entry = entry_of("density control", Fading)
    assert "signatures of DensityControl" in check_target(entry, PLUGINS)
    assert "resumes bit-equal" in BEHAVIOUR["density control"](entry, PLUGINS)


@pytest.mark.parametrize(
    ("control", "said"),
    [(FadingForgets, "resumed ends as another model"), (FadingAsks, "needs names gradients"),
     (FadingLeaves, "still has votes"), (FadingNeverAsked, "rounds is None"), (dict, "no DensityControl")],
)  # fmt: skip
def test_controls_that_do_not_keep_their_contract(entry_of, control, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["density control"](entry_of("density control", control), PLUGINS)


def in_place(render, truth):
    return float(render.sub_(truth).abs().mean())


@pytest.mark.parametrize(
    ("metric", "direction", "said"),
    [(lambda a, b: (a - b).abs().mean(), "lower", "returns a Tensor"), (in_place, "lower", "changes the images"),
     (lambda a, b: float((a - b).abs().mean()), "higher", "says the opposite"),
     (lambda a, b: float("nan"), "lower", "returns nan"),
     (lambda a, b: float(torch.rand(())), "lower", "a second call")],
)  # fmt: skip
def test_metrics_that_are_no_function_of_two_images(entry_of, metric, direction, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["metric"](entry_of("metric", metric, direction=direction), PLUGINS)


def counted(subject):
    return MetricResult(float(subject.model.num_rows), [], "lower")


def moved(subject):
    subject.model.means.data += 1
    return counted(subject)


@pytest.mark.parametrize(
    ("metric", "said"),
    [(lambda subject: 1.0, "returns a float"), (moved, "changes the model"),
     (lambda subject: MetricResult(None, [], "lower"), "mean is None"),
     (lambda subject: MetricResult(float(torch.rand(())), [], "lower"), "a second call")],
)  # fmt: skip
def test_metrics_over_models_that_measure_no_model(entry_of, metric, said):
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["metric"](entry_of("metric", metric, direction="lower", over="model"), PLUGINS)
    assert "200" in BEHAVIOUR["metric"](entry_of("metric", counted, direction="lower", over="model"), PLUGINS)


@pytest.mark.parametrize(
    ("score", "said"),
    [(lambda path: 0.5, "that is no scene"), (lambda path: 2, "a number in 0..1"), (lambda path: None, "a number"),
     (lambda path: 0.9 if (path / "sparse").is_dir() else 0.0, "another family")],
)  # fmt: skip
def test_families_that_claim_what_is_not_theirs(entry_of, score, said):
    family = types.SimpleNamespace(detect=score, load=lambda path, options: None)
    with pytest.raises(BrokenContractError, match=said):
        BEHAVIOUR["dataset"](entry_of("dataset", family), PLUGINS)
