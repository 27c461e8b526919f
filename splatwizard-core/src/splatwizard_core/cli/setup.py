"""From the options of a command to configurations and a session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from splatwizard_core.experiments.config import ResolvedConfig
    from splatwizard_core.experiments.method import Method
    from splatwizard_core.experiments.session import Session
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.scene.dataset import SceneOptions
    from splatwizard_core.training.params import PipelineParams

DEFAULT_METHOD = "3dgs"


def say(message: str) -> None:
    """A line for the user, on stderr: stdout holds results only."""
    click.echo(message, err=True)


def method_names(methods: Sequence[str], config_file: str | None) -> list[str]:
    """What `--method a,b --method c` asks for; nothing: what the configuration file says, else 3DGS."""
    names = [name.strip() for text in methods for name in text.split(",") if name.strip()]
    if names:
        return list(dict.fromkeys(names))
    if config_file is not None:
        from splatwizard_core.experiments.config import read_config_file

        return [str(read_config_file(config_file).get("method", DEFAULT_METHOD))]
    return [DEFAULT_METHOD]


def load_method(plugins: PluginManager, name: str) -> type[Method]:
    """The class of a method. Raises PluginError with the nearest installed name."""
    method: type[Method] = plugins.methods.load(name)
    return method


def resolve_all(
    plugins: PluginManager,
    methods: Sequence[str],
    rates: str | None,
    *,
    preset: str | None,
    config_file: str | None,
    values: dict[str, Any],
    scene: str | None,
) -> list[ResolvedConfig]:
    """One configuration for every method and rate point that was asked for; wrong input fails before anything runs."""
    from splatwizard_core.experiments.config import rate_points, resolve

    found = []
    for name in methods:
        cls = load_method(plugins, name)
        for rate in rate_points(cls, rates) if rates else [None]:
            found.append(resolve(cls, preset, rate, config_file, values, scene=scene))
    return found


def resolve_one(
    plugins: PluginManager,
    method: str | None,
    rate: str | None,
    *,
    preset: str | None,
    config_file: str | None,
    values: dict[str, Any],
    scene: str | None,
) -> ResolvedConfig:
    """The configuration of a command that makes one thing."""
    names = method_names([method] if method else [], config_file)
    found = resolve_all(plugins, names, rate, preset=preset, config_file=config_file, values=values, scene=scene)
    if len(found) != 1:
        raise click.UsageError("this command takes one method and one rate point; `sw run` takes several")
    return found[0]


def resolve_run_options(
    config_file: str | None, values: dict[str, Any]
) -> tuple[PipelineParams, SceneOptions, str | None]:
    """For commands that need no method: run parameters, scene options, and the scene that the file names.

    Keys of a method in the file are passed over.
    """
    from splatwizard_core.errors import ConfigError
    from splatwizard_core.experiments.config import RESERVED, SCENE_KEYS, read_config_file, resolve
    from splatwizard_core.experiments.keys import block_keys, field_at, flatten
    from splatwizard_core.experiments.method import Method
    from splatwizard_core.training.params import OptimizationParams, PipelineParams

    class NoMethod(Method):
        name = "none"
        Config = OptimizationParams

    tables = read_config_file(config_file) if config_file else {}
    from_file = {
        key: value
        for key, value in flatten(PipelineParams, tables).items()
        if key not in RESERVED and (key in SCENE_KEYS or field_at(PipelineParams, key) is not None)
    }
    known = {*SCENE_KEYS, *block_keys(PipelineParams)}
    for key in values:
        if key in OptimizationParams.model_fields:
            raise ConfigError(f"key '{key}' in --set is of no use here: one of {', '.join(sorted(known))}", key=key)
    resolved = resolve(NoMethod, "paper", "r1", sets={**from_file, **values})
    return resolved.ppl, resolved.scene, tables.get("scene")


def open_session(ppl: PipelineParams, plugins: PluginManager) -> Session:
    """Threads and device as asked."""
    from splatwizard_core.experiments.device import choose_device, set_threads
    from splatwizard_core.experiments.session import Session

    set_threads(ppl.threads)
    return Session(plugins, choose_device(ppl.device, plugins), say)


def existing(path: str) -> Path:
    """A path that must be there. Raises UserInputError."""
    from splatwizard_core.errors import UserInputError

    found = Path(path)
    if not found.exists():
        raise UserInputError(f"{path}: there is no such file or folder")
    return found
