"""`--set log.tensorboard=true`: curves go to TensorBoard's library, and the key changes no result."""

from __future__ import annotations

import builtins
import sys
from types import SimpleNamespace

import pytest
import torch
from sw_report import plugin
from sw_report.tensorboard_log import TensorBoardLog

from splatwizard_core.api import CapabilityError
from splatwizard_core.training.identity import given_values
from splatwizard_core.training.params import LogParams, PipelineParams


def record(step: int, **changes):
    given = {"stage_name": "3dgs", "step": step, "iterations": 25, "total": torch.tensor(0.5), "num_rows": 7,
             "parts": {"l1": torch.tensor(0.4)}, "scalars": {}}  # fmt: skip
    return SimpleNamespace(**given | changes)


class Writer:
    """Stands for SummaryWriter."""

    made: list[Writer] = []

    def __init__(self, folder: str, purge_step: int) -> None:
        self.folder, self.purge_step, self.closed = folder, purge_step, False
        self.values: list[tuple[str, float, int]] = []
        Writer.made.append(self)

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        self.values.append((tag, value, step))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[Writer]:
    monkeypatch.setattr(Writer, "made", [])
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    return Writer.made


def test_values_are_written_every_tenth_step_at_curves_and_at_the_end(written, tmp_path):
    log = TensorBoardLog(tmp_path)
    for step in range(5, 26):  # resumed after step 4
        log.after_step(None, record(step, scalars={"pruned": torch.tensor(3.0)} if step == 14 else {}))
    log.after_step(None, record(1, stage_name="distil"))
    log.finished()
    first, second = written
    assert first.folder == str(tmp_path / "3dgs")
    assert first.purge_step == 11  # what was written later, before the interruption, goes
    assert [step for tag, _, step in first.values if tag == "loss"] == [11, 14, 21, 25]
    assert ("tasks/pruned", 3.0, 14) in first.values
    assert [value for tag, value, _ in first.values if tag == "loss/l1"] == pytest.approx([0.4] * 4)
    assert [tag for tag, _, _ in second.values] == ["loss", "primitives", "loss/l1"]
    assert first.closed
    assert second.closed


def test_only_who_asks_is_logged(written, tmp_path):
    def started(log):
        return SimpleNamespace(log=log, directory=tmp_path)

    assert plugin.run_started(started(LogParams())) is None
    assert isinstance(plugin.run_started(started(LogParams(tensorboard=True))), TensorBoardLog)
    assert not (tmp_path / "tensorboard").exists()


def test_without_the_package_it_is_named(monkeypatch, tmp_path):
    real = builtins.__import__

    def absent(name, *rest):
        if name == "torch.utils.tensorboard":
            raise ImportError("No module named 'tensorboard'")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(CapabilityError, match=r"pip install 'sw-report\[tensorboard\]'"):
        TensorBoardLog(tmp_path)


def test_a_training_is_the_same_whether_it_is_logged_or_not():
    logged = PipelineParams(log=LogParams(tensorboard=True))
    assert given_values(logged) == given_values(PipelineParams())
    assert logged.model_dump()["log"] == {"tensorboard": True, "view": 0}


def test_tensorboards_own_library_reads_what_was_written(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    log = TensorBoardLog(tmp_path)
    for step in range(1, 26):
        log.after_step(None, record(step))
    log.finished()
    events = accumulator.EventAccumulator(str(tmp_path / "3dgs")).Reload()
    assert [each.step for each in events.Scalars("loss")] == [1, 11, 21, 25]
