"""Trainings of release 0.2 are found: what their checkpoints say of them has the key that the same training has today.

tests/golden/identities_2 holds, for each method, preset and a few values beside, the `identity` of a checkpoint of 0.2
and the key under which steps.json had it. The files are never rewritten.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from sw_gaussians import quick

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import ResolvedConfig, resolve
from splatwizard_core.runs.identity import key_when_made, stored_beside, stored_key, training_identity, training_key
from splatwizard_core.runs.session import Session
from splatwizard_core.training.checkpoint import normalised
from splatwizard_core.training.keys import dotted

FOLDER = Path(__file__).parent / "golden" / "identities_2"
CASES = [
    pytest.param(path.stem, case, id=f"{path.stem}-{case['preset']}{'+' * bool(case['sets'])}")
    for path in sorted(FOLDER.glob("*.json"))
    for case in json.loads(path.read_text())
]


PIXELS = "v_important_score"
LONGER = {"iterations": 2_000, **quick.LONGER}
SPEEDY = {
    "base.preset": "quick",
    "iterations": 2_500, "prune.start": 500, "prune.stop": 2_400, "prune.interval": 500, "base.lr.max_steps": 2_500,
    "base.density.settings.stop": 1_500, "base.density.settings.grad_threshold": 3e-4,
}  # fmt: skip
CHIMERA = {
    "iterations": 2_500, "train.stop": 1_900, "distill.iterations": 1_000, "distill.beta2": 0.999,
    "distill.lr.position_init": 2e-4, "distill.lr.position_final": 4e-6, "distill.lr.max_steps": 1_000,
    "distill.lr.sh_dc": 1e-2, "distill.lr.scales": 1e-2, "distill.lr.decay_interval": 100,
}  # fmt: skip
STARTED = (
    "c3dgs", "compressed-ply", "lightgaussian", "mesongs", "pup-3dgs", "sog", "splat", "spz", "trimming-the-fat",
    "chimerags",
)  # fmt: skip
SINCE: dict[tuple[str, str], dict[str, Any]] = {
    ("lightgaussian", "paper"): {"prune.settings.kind": PIXELS, "score.settings.kind": PIXELS},
    ("3dgs", "quick"): LONGER,
    ("3dgs", "fast-cpu"): {
        "iterations": 2_400, "lr.position_init": 8e-4, "lr.sh_dc": 1e-2, "lr.sh_rest": 1e-3, "lr.scales": 1e-2,
        "lr.quats": 2e-3, "lr.beta2": 0.999,
    },
    ("speedy-splat", "quick"): SPEEDY,
    **{(name, "quick"): {f"pretrained.{key}": value for key, value in LONGER.items()} for name in STARTED},
}  # fmt: skip
SINCE["chimerags", "quick"] |= CHIMERA
"""Values of then in presets that have others since."""


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(load_plugins(), torch.device("cpu"), print)


def asked(name: str, case: dict[str, Any], **sets: Any) -> ResolvedConfig:
    values = {**SINCE.get((name, case["preset"]), {}), **case["sets"], **sets}
    # Today's quick preset of speedy-splat gives keys of 3DGS that then were left to 3DGS.
    preset = "paper" if (name, case["preset"]) == ("speedy-splat", "quick") else case["preset"]
    return resolve(load_plugins().methods.load(name), preset, sets=values, scene="demo:tiny")


@pytest.mark.parametrize(("name", "case"), CASES)
def test_the_key_of_then_follows_from_what_the_checkpoint_says(name: str, case: dict[str, Any]):
    assert key_when_made(case["identity"]) == case["key"]


@pytest.mark.parametrize(("name", "case"), CASES)
def test_the_key_of_today_is_that_of_the_same_values(name: str, case: dict[str, Any], session: Session):
    resolved = asked(name, case)
    assert stored_key(session.plugins, case["identity"]) == training_key(session, resolved)
    today = training_identity(session, resolved)
    assert stored_beside(session.plugins, case["identity"], today) == today
    other = training_identity(session, asked(name, case, iterations=7))
    told = dotted(normalised(stored_beside(session.plugins, case["identity"], other)), "")
    differing = {key for key, value in dotted(normalised(other), "").items() if told.get(key) != value}
    # A method that is built on another gives its length to that one.
    assert {key for key in differing if not key.startswith("built on.")} - {"config.growth.subvoxel"} == {
        "config.iterations"
    }


@pytest.mark.parametrize(("name", "case"), CASES)
def test_a_checkpoint_of_today_has_the_key_of_its_training(name: str, case: dict[str, Any], session: Session):
    resolved = asked(name, case)
    stored = normalised(training_identity(session, resolved))
    assert key_when_made(stored) == stored_key(session.plugins, stored) == training_key(session, resolved)


def test_every_method_of_ours_has_its_cases():
    assert {path.stem for path in FOLDER.glob("*.json")} <= set(load_plugins().methods.names)
    assert len(CASES) > 60
