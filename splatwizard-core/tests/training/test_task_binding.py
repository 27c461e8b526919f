"""What an annotation selects, and what is refused at registration. Annotations are objects here; strings below."""

import functools
import typing
from typing import Annotated, Optional, TypeVar, Union

import pytest
import torch

from splatwizard_core.errors import TaskSignatureError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer, RenderResult
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.scheduler import Scheduler
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.tasks import TaskContext


class SubModel(GaussianModel):
    pass


class OtherModel(SplatModel):
    pass


class SubOptions(OptimizationParams):
    strength: float = 1.0


class SubIterator(CameraIterator):
    pass


class SubResult(RenderResult):
    pass


ModelT = TypeVar("ModelT", bound=SplatModel)
LateBoundT = TypeVar("LateBoundT", bound="GaussianModel")
ConstrainedT = TypeVar("ConstrainedT", GaussianModel, OtherModel)
UnboundT = TypeVar("UnboundT")


@pytest.fixture
def context(toy):
    model = toy.make_model(toy.scene, SubModel)
    return TaskContext(
        PipelineParams(),
        SubOptions(strength=3.0),
        model,
        toy.scene,
        SplatOptimizer(model, []),
        SubIterator(toy.scene.train),
        toy.Rasterizer(),
        result=SubResult(torch.zeros(3, 1, 1), torch.zeros(0), None),
        loss=LossPack(torch.tensor(1.0)),
    )


def run(task, context, *, step=7, stage="post"):
    scheduler = Scheduler(stage)
    scheduler.register_task(step, task)
    scheduler.exec(step, context)
    return scheduler


def calls(*annotations):
    """A task with one parameter for each annotation, and the list in which its arguments end up."""
    seen = []
    names = [f"p{i}" for i in range(len(annotations))]
    namespace = {"seen": seen}
    exec(f"def task({', '.join(names)}): seen.append(({', '.join(names)},))", namespace)
    namespace["task"].__annotations__ = dict(zip(names, annotations, strict=True))
    return namespace["task"], seen


@pytest.mark.parametrize(
    ("annotation", "field"),
    [
        (PipelineParams, "ppl"),
        (OptimizationParams, "opt"),
        (SubOptions, "opt"),
        (SplatModel, "model"),
        (GaussianModel, "model"),
        (SubModel, "model"),
        (torch.nn.Module, "model"),
        (Scene, "scene"),
        (SplatOptimizer, "optimizer"),
        (CameraIterator, "cameras"),
        (SubIterator, "cameras"),
        (Rasterizer, "rasterizer"),
        (RenderResult, "result"),
        (SubResult, "result"),
        (LossPack, "loss"),
        (int, "step"),
        (Optional[GaussianModel], "model"),  # noqa: UP045 (the old spelling is what is tested)
        (GaussianModel | None, "model"),
        (Union[SubModel, OtherModel], "model"),  # noqa: UP007
        (Annotated[GaussianModel, "the scene"], "model"),
        (Annotated[Optional[Annotated[GaussianModel, 1]], 2], "model"),  # noqa: UP045
        (ModelT, "model"),
        (LateBoundT, "model"),
        (ConstrainedT, "model"),
        (Optional[ModelT], "model"),  # noqa: UP045
        ("GaussianModel", "model"),
        ("Optional[SubOptions]", "opt"),
        ("typing.Annotated[Scene, 1] | None", "scene"),
    ],
)
def test_annotation_selects(annotation, field, context):
    task, seen = calls(annotation)
    task.__globals__.update(globals())
    run(task, context)
    ((argument,),) = seen
    assert argument is getattr(context, field)


def test_the_scheduler_itself_can_be_asked_for(context):
    task, seen = calls(Scheduler, int)
    scheduler = run(task, context, step=9)
    assert seen == [(scheduler, 9)]


def test_arguments_come_in_the_order_of_the_parameters(context):
    task, seen = calls(int, SplatModel, PipelineParams, int)
    run(task, context, step=4)
    assert seen == [(4, context.model, context.ppl, 4)]


@pytest.mark.parametrize("annotation", [RenderResult, SubResult, LossPack, Optional[RenderResult]])  # noqa: UP045
def test_results_do_not_exist_before_rendering(annotation):
    task, _ = calls(annotation)
    with pytest.raises(TaskSignatureError, match="exists after rendering only"):
        Scheduler("pre").register_task(1, task)


@pytest.mark.parametrize(
    "annotation",
    [float, bool, str, torch.Tensor, torch.Generator, object, typing.Any, list[int], UnboundT, int | float,
     SplatModel | Scene, None, "float"],
)  # fmt: skip
def test_what_nothing_can_be_supplied_for_is_refused_at_registration(annotation):
    task, _ = calls(annotation)
    with pytest.raises(TaskSignatureError, match=r"parameter 'p0.*possible are int"):
        Scheduler("post").register_task(1, task)


def test_a_parameter_without_annotation_is_refused():
    with pytest.raises(TaskSignatureError, match="parameter 'model' has no annotation"):
        Scheduler("pre").register_task(1, lambda model: None)


def test_a_default_is_used_where_nothing_can_be_supplied(context):
    seen = []

    def task(plain=5, model: GaussianModel = None, ratio: float = 0.5, *, last: int):
        seen.append((plain, model, ratio, last))

    run(task, context, step=3)
    assert seen == [(5, context.model, 0.5, 3)]


@pytest.mark.parametrize("task", [lambda *args: None, lambda **kwargs: None])
def test_star_parameters_are_refused(task):
    with pytest.raises(TaskSignatureError, match=r"\*(args|kwargs) cannot be supplied"):
        Scheduler("pre").register_task(1, task)


def test_a_class_itself_is_refused():
    with pytest.raises(TaskSignatureError, match="register an instance"):
        Scheduler("pre").register_task(1, SubModel)


def test_an_unresolvable_string_names_the_remedy():
    def task(model: "NotImported") -> None:  # noqa: F821
        pass

    with pytest.raises(TaskSignatureError, match=r"'NotImported' of parameter 'model'.*TYPE_CHECKING"):
        Scheduler("pre").register_task(1, task)


def test_a_string_that_is_no_type_is_refused():
    task, _ = calls("not a type")
    with pytest.raises(TaskSignatureError, match="is not a type"):
        Scheduler("pre").register_task(1, task)


def test_the_return_annotation_is_not_read(context):
    def task(step: int) -> "NeverDefined":  # noqa: F821
        pass

    run(task, context)


class Tasks:
    def __init__(self):
        self.seen = []

    def method(self, step: int, scene: Scene):
        self.seen.append((step, scene))

    def __call__(self, model: SplatModel):
        self.seen.append(model)

    @staticmethod
    def static(step: int):
        return step

    @classmethod
    def of_class(cls, step: int):
        return cls, step


def test_methods_and_callable_objects(context):
    tasks = Tasks()
    run(tasks.method, context)
    run(tasks, context)
    run(tasks.static, context)
    run(Tasks.of_class, context)
    assert tasks.seen == [(7, context.scene), context.model]


def test_partials_keep_what_they_are_given(context):
    seen = []

    def task(a, model: GaussianModel, amount: int, scene: Scene, flag=False):
        seen.append((a, model, amount, scene, flag))

    run(functools.partial(task, "first", amount=5), context)
    run(functools.partial(functools.partial(task, "outer"), amount=6, flag=True), context)
    run(functools.partial(Tasks().method, 99), context)
    assert seen == [
        ("first", context.model, 5, context.scene, False),
        ("outer", context.model, 6, context.scene, True),
    ]


def test_a_wrapped_function_is_seen_through(context):
    seen = []

    @torch.no_grad()
    def task(step: int):
        seen.append(step)

    run(task, context)
    assert seen == [7]


def test_a_lambda_without_parameters_is_fine(context):
    seen = []
    run(lambda: seen.append(1), context)
    assert seen == [1]


def test_a_model_of_another_class_is_named_with_both_types(context):
    task, _ = calls(OtherModel)
    with pytest.raises(TaskSignatureError, match="wants OtherModel, this run has SubModel"):
        run(task, context)


def test_a_union_of_models_takes_either(context):
    task, seen = calls(GaussianModel | OtherModel)
    run(task, context)
    context.model = OtherModel()
    run(task, context)
    assert [type(args[0]) for args in seen] == [SubModel, OtherModel]


def test_none_is_supplied_only_where_the_annotation_allows_it(context):
    context.optimizer = None
    task, seen = calls(SplatOptimizer | None)
    run(task, context)
    assert seen == [(None,)]
    task, _ = calls(SplatOptimizer)
    with pytest.raises(TaskSignatureError, match="wants SplatOptimizer, this run has NoneType"):
        run(task, context)


def test_types_are_checked_before_training_begins(context):
    scheduler = Scheduler("post")
    task, _ = calls(RenderResult, LossPack, int, Scheduler)
    scheduler.register_task(20_000, task)
    context.result = context.loss = None
    scheduler.check(context)
    task, _ = calls(OtherModel)
    scheduler.register_task(20_000, task)
    with pytest.raises(TaskSignatureError, match="wants OtherModel"):
        scheduler.check(context)


def test_a_positional_only_parameter_behind_a_left_out_one_is_refused():
    def task(a=1, step: int = 0, /):
        pass

    with pytest.raises(TaskSignatureError, match="positional-only"):
        Scheduler("pre").register_task(1, task)


def test_a_callable_whose_signature_cannot_be_read_is_refused():
    with pytest.raises(TaskSignatureError, match="signature cannot be read"):
        Scheduler("pre").register_task(1, iter)
