"""The one object that a training is: what tasks get of it and keep in it, what earlier checkpoints called it."""

import json
import zlib

import pytest

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.training.measurements import TrainingFigures
from splatwizard_core.training.params import OptimizationParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.state import TrainingState


class Counting:
    """A task that counts its calls and keeps the count."""

    def __init__(self):
        self.calls = 0

    def __call__(self, state: TrainingState):
        self.calls += 1
        state.log.scalar("calls", self.calls)

    def state_dict(self):
        return {"calls": self.calls}

    def load_state_dict(self, state):
        self.calls = state["calls"]


def stage_with(toy, task, iterations=30):
    class Own(toy.Stage):
        def register_post_task(self, scheduler, ppl, opt):
            super().register_post_task(scheduler, ppl, opt)
            scheduler.register_task(range(100), task, name="count")

    return Own(OptimizationParams(iterations=iterations))


def test_a_task_may_ask_for_the_training_itself(toy):
    seen = []

    def look(state: TrainingState, model: GaussianModel, step: int):
        assert state.model is model
        assert state.result is not None
        seen.append((state.step, step, state.stage_name, state.index))

    toy.train([stage_with(toy, look, 3)])
    assert seen == [(1, 1, "toy", 0), (2, 2, "toy", 0), (3, 3, "toy", 0)]


def test_what_a_task_keeps_survives_a_checkpoint(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train([stage_with(toy, Counting())], directory=tmp_path, stop_after=20)
    task = Counting()
    toy.train([stage_with(toy, task)], directory=tmp_path)
    assert task.calls == 30


def test_a_checkpoint_from_before_tasks_kept_something_is_read(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train([stage_with(toy, Counting())], directory=tmp_path, stop_after=20)
    rewritten(tmp_path / "00-0000020.json", lambda content: content["state"].pop("tasks"))
    task = Counting()
    assert toy.train([stage_with(toy, task)], directory=tmp_path).figures.steps == 30
    assert task.calls == 10


def test_figures_of_earlier_releases_have_other_names(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=60, directory=tmp_path, stop_after=20)
    before = {
        "stage_seconds": {"toy": 1000.0}, "stage_steps": {"toy": 20}, "breakdown": {"toy": {"render": 3.0}},
        "peak_memory": 1 << 50, "rasterizers": {"BACKWARD": "soft"}, "pictures_in": "host", "provided": {},
    }  # fmt: skip
    rewritten(tmp_path / "00-0000020.json", lambda content: content.update(progress=before))
    found = toy.train(iterations=60, directory=tmp_path).figures
    assert found.peak_bytes == 1 << 50
    assert found.breakdown_s == {"toy": {"render": 3.0}}
    assert int(found.train_s) // 1000 == 1  # the file has 1,000 s; a toy needs less
    assert found.steps == 60


def test_figures_come_back_from_their_file():
    found = TrainingFigures(stage_steps={"toy": 3}, peak_bytes=5, breakdown_s={"toy": {"pre": 1.0}})
    assert TrainingFigures.model_validate(json.loads(found.model_dump_json())) == found


def rewritten(path, change):
    """Change the content of a checkpoint's JSON file, its checksum included."""
    content = json.loads(path.read_text())["content"]
    change(content)
    path.write_text(json.dumps({"crc": zlib.crc32(json.dumps(content).encode()), "content": content}))
