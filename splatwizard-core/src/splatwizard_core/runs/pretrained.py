"""The trained scene of another method, or of a file, that a training starts from.

A stage names the method (`starts_from`, `taught_by`). How its scene is trained follows from the run: the same preset if
that method has it, the same run and scene options, and the values of `pretrained.KEY`. With `init = FILE.ply` the file
is that scene instead.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatwizard_core.errors import ConfigError, SplatwizardError, UserInputError, no_file
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.method import Method
from splatwizard_core.plugins import PluginManager, load_plugins
from splatwizard_core.runs.config import INIT, ResolvedConfig, resolve
from splatwizard_core.runs.decode import read_gaussians
from splatwizard_core.training.added_tasks import add_tasks
from splatwizard_core.training.keys import field_at, input_files, is_beside_method, value_at
from splatwizard_core.training.overrides import apply_overrides
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.stage import Stage

PRESET = "preset"  # `pretrained.preset`: of the method that is started from


def make_method(plugins: PluginManager, resolved: ResolvedConfig) -> Method:
    """Return the configured method."""
    return plugins.methods.load(resolved.method)(plugins, resolved.config)


def planned_stages(plugins: PluginManager, resolved: ResolvedConfig) -> list[Stage]:
    """Return the stages of a configuration with the tasks that it adds to their plans. Raises as `add_tasks`."""
    return add_tasks(make_method(plugins, resolved).stages(), resolved.ppl.tasks, plugins)


def named_scenes(method: Method) -> list[str]:
    """List the methods whose trained scenes the stages start from or are taught by, that of the first stage first."""
    stages = list(method.stages())
    names = [name for stage in stages for name in (stage.starts_from, *stage.taught_by) if name is not None]
    return list(dict.fromkeys(names))


def first_scene(method: Method) -> str | None:
    """Name the method whose trained scene the first stage starts from; None: from the scene's points, say."""
    return method.stages()[0].starts_from


def base_config(plugins: PluginManager, name: str, outer: ResolvedConfig) -> ResolvedConfig:
    """Return the configuration that trains the scene of method `name` which `outer` starts from.

    Raises PluginError if the method is not installed, ConfigError that names the key `pretrained.KEY`.
    """
    cls = plugins.methods.load(name)
    wanted = dict(outer.pretrained)
    asked = wanted.pop(PRESET, None)
    preset = asked if asked is not None else outer.preset if outer.preset in cls.PRESETS else "paper"
    beside = next((key for key in wanted if is_beside_method(cls.Config, key)), None)
    if beside is not None:
        raise ConfigError(
            f"'pretrained.{beside}' is no key of '{name}' but one of the run: give '{beside}', which holds for both",
            key=f"pretrained.{beside}",
        )
    try:
        base = resolve(cls, str(preset), sets=wanted, scene=outer.scene_spec or None, plugins=plugins)
    except ConfigError as error:
        # What the other method's configuration says of its keys, with the names that they have here.
        told = re.sub(r"\b(key|for|mean) '([\w.]+)'", r"\1 'pretrained.\2'", str(error))
        raise ConfigError(told, key=error.key) from None
    # What a preset says about the run (clamped renders, say) belongs to the base method; the rest is as outside.
    said = {key: value for key, value in cls.PRESETS[base.preset].items() if field_at(PipelineParams, key) is not None}
    own = outer.ppl.model_copy(update={"tasks": []})  # those of [[tasks]] belong to the plan of `outer`
    ppl = apply_overrides(own, said, source=f"preset '{base.preset}' of '{name}'")
    return replace(base, ppl=ppl, scene=outer.scene)


def useful_starts(plugins: PluginManager, resolved: ResolvedConfig) -> set[str]:
    """Name which of "init" and "pretrained" the method of a configuration has a use for."""
    method = make_method(plugins, resolved)
    if first_scene(method) is not None:
        return {"init", "pretrained"}
    return {"pretrained"} if named_scenes(method) else set()


def for_starts(plugins: PluginManager, resolved: ResolvedConfig, keys: Iterable[str]) -> dict[str, Any]:
    """Map keys to their values, for those that the trainings of all scenes that it starts from have.

    keys    those that were given: the scenes that a method starts from are trained by them too, as the one that
            stands beside it in a table is
    Without those that only encode, those for which the configuration says `pretrained.KEY` itself, and no steps at
    all: a scene to start from is trained.
    """
    method = make_method(plugins, resolved)
    first = first_scene(method) if resolved.init else None
    bases = [plugins.methods.load(name).Config for name in named_scenes(method) if name != first]
    return {
        key: value_at(resolved.config, key)
        for key in keys
        if bases and key not in resolved.pretrained and field_at(type(resolved.config), key) is not None
        and all(field_at(b, key) is not None and key.partition(".")[0] not in b.ENCODING for b in bases)
        and (key != "iterations" or value_at(resolved.config, key) > 0)
    }  # fmt: skip


def own_start(resolved: ResolvedConfig) -> str:
    """Return the file that a method with an input file `init` starts from; empty: none."""
    return str(value_at(resolved.config, INIT)) if INIT in input_files(type(resolved.config)) else ""


def checked_start(plugins: PluginManager, resolved: ResolvedConfig) -> ResolvedConfig:
    """Return the configuration with its start checked, and the values of `pretrained.KEY` parsed.

    Before anything runs: raises UserInputError for a file that is no model, ConfigError for a wrong key or value, or
    for either of them where the method starts from no trained scene.
    """
    if resolved.ppl.tasks:
        planned_stages(plugins, resolved)
    given = {
        **({INIT: f"'init' ({resolved.init})"} if resolved.init else {}),
        **{f"pretrained.{key}": f"'pretrained.{key}'" for key in resolved.pretrained},
    }
    useful = useful_starts(plugins, resolved) if given else set[str]()
    for key, told in given.items():
        if key.partition(".")[0] not in useful:
            raise ConfigError(
                f"method '{resolved.method}' does not start from a trained scene, so {told} is of no use to it: "
                "leave it out",
                key=key,
            )
    if resolved.pretrained:
        method, parsed = make_method(plugins, resolved), dict(resolved.pretrained)
        names, first = named_scenes(method), first_scene(method)
        if resolved.init and names == [first]:
            asked = [key for key in (f"pretrained.{name}" for name in parsed) if not resolved.is_usual(key)]
            if not asked:  # what a preset says of the scene to train has no say where a file is that scene
                return checked_start(plugins, replace(resolved, pretrained={}))
            raise ConfigError(
                f"'{asked[0]}' is about training a {first} scene, and 'init' ({resolved.init}) is one: give one of "
                "them",
                key=asked[0],
            )
        for base in (base_config(plugins, name, resolved) for name in names):
            parsed |= {k: value_at(base.config, k) for k in parsed if field_at(type(base.config), k) is not None}
            checked_start(plugins, base)
        resolved = replace(resolved, pretrained=parsed)
    for path in filter(None, (resolved.init, own_start(resolved))):
        stamp = os.stat(path).st_mtime_ns if os.path.exists(path) else 0
        _checked_once(path, stamp)  # a command with many rate points asks as often
    return resolved


@functools.cache
def _checked_once(path: str, stamp: int) -> None:
    check_model(path)


def check_model(path: str) -> GaussianModel:
    """Read the explicit Gaussians of a .ply. Raises UserInputError that says what is wrong with it, and what to do."""
    where = Path(path)
    if where.is_dir():
        inside = sorted(where.rglob("*.ply"))
        hint = f"name the .ply in it, such as {inside[-1]}" if inside else "it has to be the .ply of a trained scene"
        raise UserInputError(f"init: {path} is a folder: {hint}")
    if not where.is_file():
        raise UserInputError(f"init: {path}: {no_file(where)}")
    with open(where, "rb") as file:
        if file.read(4) == b"SPWZ":
            raise UserInputError(f"init: {path} is an encoded file: `sw export {path} FILE.ply` makes a .ply of it")
    try:
        model = read_gaussians(where, load_plugins())
    except SplatwizardError as error:
        reason = str(error).removeprefix(f"{where}: ").removeprefix(f"{where.name}: ")
        raise UserInputError(f"init: {path}: {reason}") from None
    if model.num_rows == 0:
        raise UserInputError(f"init: {path} holds no Gaussian")
    return model
