"""Tasks of a module whose annotations are all strings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional

import pytest

from splatwizard_core.errors import TaskSignatureError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.training.scheduler import Scheduler
from splatwizard_core.training.tasks import bind

if TYPE_CHECKING:
    from splatwizard_core.scene.scene import Scene


def plain(model: GaussianModel, step: int) -> None:
    pass


def optional(model: Optional[GaussianModel]) -> None:  # noqa: UP045
    pass


class Callable:
    def __call__(self, model: GaussianModel | None, scheduler: int) -> None:
        pass


def hidden(scene: Scene) -> None:
    pass


@pytest.mark.parametrize(("task", "fields"), [(plain, ["model", "step"]), (optional, ["model"]),
                                              (Callable(), ["model", "step"]),
                                              (Callable().__call__, ["model", "step"])])  # fmt: skip
def test_string_annotations_are_resolved(task, fields):
    assert [a.field for a in bind(task, "pre", "it").arguments] == fields


def test_a_name_that_exists_for_type_checkers_only_is_refused():
    with pytest.raises(TaskSignatureError, match=r"'Scene' of parameter 'scene'.*import the name at run time"):
        Scheduler("pre").register_task(1, hidden)
