"""Each method that trains from points has a key with which it begins with small pictures, and ends with whole ones."""

import itertools
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from small_scene import WIDTH, small_scene
from sw_anchors.params import AnchorParams
from sw_anchors.stage import AnchorStage
from sw_gaussians.config import GaussianTraining
from sw_gaussians.resolution import ResolutionSampler
from sw_gaussians.stage import ThreeDGSStage

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs.config import resolve
from splatwizard_core.streams import stream
from splatwizard_core.training.added_tasks import add_tasks
from splatwizard_core.training.params import AddedTask, PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage

PLUGINS = load_plugins()
KEYS = {
    "3dgs": "pictures.schedule", "2dgs": "pictures.schedule", "flat-3dgs": "pictures.schedule",
    "speedy-splat": "base.pictures.schedule", "trim-2dgs-scratch": "base.pictures.schedule",
    "chimerags": "student.base.pictures.schedule", "compact3dgs": "pictures.schedule",
    "hac": "pictures.schedule", "hac-plus": "pictures.schedule", "cat-3dgs": "pictures.schedule",
}  # fmt: skip
GROWTH = {"prune and densify", "adjust anchor"}
STEPS = 600


def stage_of(name: str, **sets: object) -> Stage:
    """First stage of a method, its published plan scaled to 600 steps."""
    cls = PLUGINS.methods.load(name)
    wanted = {"iterations": STEPS, "scale_schedule": True, **{key.replace("__", "."): v for key, v in sets.items()}}
    return cls(PLUGINS, resolve(cls, "paper", sets=wanted).config).stages()[0]


def rounds_of(stage: Stage) -> Iterator[int]:
    """Steps at which Gaussians or anchors are added, after which statistics start again."""
    _, post = build_schedulers(stage, PipelineParams())
    return (s for s in range(1, STEPS + 1) if any(e.due(s) and _name(e) in GROWTH for e in post.registrations))


def _name(entry) -> str:
    return entry.name.replace("_", " ")


def test_each_method_that_trains_from_points_has_a_key():
    """A method whose first stage takes steps from a trained scene, or none, has whole pictures."""
    own = [entry.name for entry in PLUGINS.methods if is_ours(entry.distribution)]
    stages = {name: PLUGINS.methods.load(name)(PLUGINS, PLUGINS.methods.load(name).Config()).stages() for name in own}
    assert {name for name, found in stages.items() if found[0].starts_from is None} == set(KEYS)


@pytest.mark.parametrize("name", KEYS)
def test_pictures_grow_where_statistics_start_again_and_are_whole_at_the_end(name):
    stage = stage_of(name, **{KEYS[name]: "dash"})
    sampler = stage.create_sampler(small_scene(), stream(0, "sampler"))
    widths = {step: sampler.next(step).camera.width for step in range(1, STEPS + 1)}
    rounds = set(rounds_of(stage))
    assert len(rounds) > 20
    grown = {step for step, after in itertools.pairwise(widths) if widths[after] != widths[step]}
    assert grown
    assert grown <= {*rounds, sampler.plan.times[-1]}
    assert list(widths.values()) == sorted(widths.values())
    assert widths[1] <= WIDTH / 2
    assert {widths[step] for step in widths if step > max(rounds) + 1} == {WIDTH}


OWN = [name for name, key in KEYS.items() if key == "pictures.schedule"]


@pytest.mark.parametrize("name", OWN)
def test_an_end_of_small_pictures_without_a_schedule_is_refused(name):
    with pytest.raises(ConfigError, match=r"set pictures\.schedule=dash"):
        stage_of(name, pictures__until=300)


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize(
    "values", [{"pictures__until": 10**12}, {"pictures__until": STEPS + 1, "scale_schedule": False}]
)
def test_pictures_that_never_become_whole_are_refused(name, values):
    with pytest.raises(ConfigError, match=r"pictures\.until is \d+, and the plan ends at"):
        stage_of(name, pictures__schedule="dash", **values)


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("share", [0.2, 0.8])
def test_pictures_may_be_whole_before_growth_is_over_or_after(name, share):
    full = PLUGINS.methods.load(name).Config.FULL_ITERATIONS
    stage = stage_of(name, pictures__schedule="dash", pictures__until=round(share * full))
    sampler = stage.create_sampler(small_scene(), stream(0, "sampler"))
    widths = {step: sampler.next(step).camera.width for step in range(1, STEPS + 1)}
    growth = sorted(rounds_of(stage))
    grown = [step for step, after in itertools.pairwise(widths) if widths[after] != widths[step]]
    assert set(grown) & set(range(growth[-1])) <= set(growth)
    until = round(share * STEPS)
    assert until <= sampler.plan.times[-1] <= until + 10
    assert (grown[-1] > growth[-1]) == (until > growth[-1])
    assert widths[STEPS] == WIDTH


@pytest.mark.parametrize("name", KEYS)
def test_pictures_are_whole_unless_asked_for(name):
    sampler = stage_of(name).create_sampler(small_scene(), stream(0, "sampler"))
    assert not isinstance(sampler, ResolutionSampler)
    assert sampler.next(1).camera.width == WIDTH


@pytest.mark.parametrize("name", OWN)
def test_a_schedule_that_is_not_registered_is_refused(name):
    for schedule in ("dahs", "update-lr"):  # the second one is a task, but not of picture sizes
        with pytest.raises(ConfigError, match=f"no schedule of picture sizes is called '{schedule}'; .* none, dash"):
            stage_of(name, pictures__schedule=schedule)


@pytest.mark.parametrize("stage", [ThreeDGSStage, AnchorStage])
def test_a_stage_that_was_not_given_its_schedule_is_refused(stage):
    config = {ThreeDGSStage: GaussianTraining, AnchorStage: AnchorParams}[stage](pictures={"schedule": "dash"})
    with pytest.raises(PluginError, match=r"does not reach the training.*pictures\.load"):
        stage(config)


def test_a_configured_task_draws_small_pictures_in_any_stage():
    task = AddedTask(name="dash", steps="range(0, 600)", before_render=True, settings={"full_at": 300, "most": 2})
    (stage,) = add_tasks([stage_of("3dgs")], [task], PLUGINS)
    pre, _ = build_schedulers(stage, PipelineParams())
    scene = small_scene()
    state = SimpleNamespace(sampler=stage.create_sampler(scene, stream(0, "sampler")), scene=scene)
    (entry,) = (entry for entry in pre.registrations if entry.name == "dash")
    widths = []
    for step in range(1, STEPS + 1):
        entry.task(state)
        widths.append(state.sampler.next(step).camera.width)
    assert widths[0] < WIDTH
    assert widths == sorted(widths)
    assert widths[300:] == [WIDTH] * 300
