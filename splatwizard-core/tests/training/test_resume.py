"""A run that is stopped and resumed ends in the same bits as one that is not."""

import pytest

from splatwizard_core.training.pipeline import TrainingStopped


@pytest.mark.parametrize("stop", [1, 44, 45, 100, 199])
def test_stopped_and_resumed_equals_one_go(toy, tmp_path, stop):
    whole = toy.train(iterations=200)
    with pytest.raises(TrainingStopped):
        toy.train(iterations=200, directory=tmp_path, stop_after=stop)
    resumed = toy.train(iterations=200, directory=tmp_path)
    assert whole.model.num_rows != 40  # densification did something
    assert resumed.model.digest() == whole.model.digest()
    assert resumed.steps == 200
