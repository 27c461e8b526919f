"""Peak memory of a training is that of its loop."""

import pytest
from fresh_memory import fresh_memory

from splatwizard_core.base.memory import reset_peak_rss
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.params import PipelineParams

MEGABYTE = 1 << 20
PART = 200 * MEGABYTE  # far above what the toy training takes

pytestmark = pytest.mark.skipif(not reset_peak_rss(), reason="this system cannot reset a resident set's peak")


def touch(*_: object) -> None:
    """Memory that is there for a moment."""
    fresh_memory(PART)


def test_what_the_loop_takes_counts(toy):
    # A few pages of what was there before may go meanwhile.
    assert toy.train(iterations=4, on_step=touch).figures.peak_bytes >= 0.95 * PART


def test_an_evaluation_on_the_way_does_not(toy):
    outcome = toy.train(iterations=6, evaluate=touch, ppl=PipelineParams(eval_every=2))
    assert outcome.figures.peak_bytes < PART / 2


def test_writing_a_checkpoint_does_not(toy, tmp_path, monkeypatch: pytest.MonkeyPatch):
    write = CheckpointStore.write
    monkeypatch.setattr(CheckpointStore, "write", lambda self, saved: (touch(), write(self, saved)))
    outcome = toy.train(iterations=6, directory=tmp_path, ppl=PipelineParams(checkpoint_every=2))
    assert outcome.figures.peak_bytes < PART / 2
