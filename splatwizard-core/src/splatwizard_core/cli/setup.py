"""From the options of a command to configurations and a session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.cli.streams import without_orders

if TYPE_CHECKING:
    from splatwizard_core.method import Method
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.runs.config import ResolvedConfig
    from splatwizard_core.runs.session import Session
    from splatwizard_core.scene.dataset import SceneOptions
    from splatwizard_core.training.params import PipelineParams

DEFAULT_METHOD = "3dgs"


def say(message: str) -> None:
    """A line for the user, on stderr: stdout holds results only."""
    click.echo(without_orders(message), err=True)


def method_names(methods: Sequence[str], config_file: str | None) -> list[str]:
    """What `--method a,b --method c` asks for; nothing: what the configuration file says, else 3DGS."""
    names = [name.strip() for text in methods for name in text.split(",") if name.strip()]
    if names:
        return list(dict.fromkeys(names))
    if methods:
        raise click.UsageError("--method is empty: give a name, or leave it out")
    if config_file is not None:
        from splatwizard_core.errors import ConfigError
        from splatwizard_core.runs.config import read_config_file

        said = read_config_file(config_file).get("method", DEFAULT_METHOD)
        if not isinstance(said, str) or not said.strip():
            raise ConfigError(f"bad value {said!r} for 'method' in {config_file}: expected a name", key="method")
        return [said]
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
    from splatwizard_core.runs.config import rate_points, resolve
    from splatwizard_core.runs.pretrained import checked_start

    found = []
    for name in methods:
        cls = load_method(plugins, name)
        for rate in rate_points(cls, rates) if rates is not None else [None]:
            found.append(resolve(cls, preset, rate, config_file, values, scene=scene))
    return [checked_start(plugins, each) for each in _left_to_those_with_a_use(plugins, found)]


def _left_to_those_with_a_use(plugins: PluginManager, found: list[ResolvedConfig]) -> list[ResolvedConfig]:
    """Of several methods, those that start from nothing trained leave --init and `pretrained.KEY` to the others."""
    from splatwizard_core.runs.pretrained import unused_start

    alone: dict[str, dict[str, Any]] = {"init": {"pretrained": {}}, "pretrained": {"init": ""}}
    without: dict[str, dict[str, Any]] = {"init": {"init": ""}, "pretrained": {"pretrained": {}}}
    for what in alone:
        useless = {
            each.method: error
            for each in found
            if (error := unused_start(plugins, replace(each, **alone[what]))) is not None
        }
        if len(useless) < len({each.method for each in found}):  # else it is wrong, and told so
            for name, error in useless.items():
                say(f"{name} does not start from a trained scene: '{error.key}' is for the others")
            found = [replace(each, **without[what]) if each.method in useless else each for each in found]
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
    names = method_names([] if method is None else [method], config_file)
    found = resolve_all(plugins, names, rate, preset=preset, config_file=config_file, values=values, scene=scene)
    if len(found) != 1:
        raise click.UsageError("this command takes one method and one rate point; `sw run` takes several")
    return found[0]


def rate_values(plugins: PluginManager, method: str | None, rate: str, config_file: str) -> dict[str, Any]:
    """What another rate point changes in the configuration of a run: the values of every key that rate points set.

    Raises ConfigError for an unknown rate point.
    """
    from splatwizard_core.runs.config import read_config_file, resolve
    from splatwizard_core.training.keys import value_at

    (name,) = method_names([] if method is None else [method], config_file)
    cls = load_method(plugins, name)
    preset = read_config_file(config_file).get("preset", "paper")
    wanted = resolve(cls, str(preset), rate)
    keys = dict.fromkeys(key for values in cls.RATES.values() for key in values)
    return {key: value_at(wanted.config, key) for key in keys if field_in_config(cls, key)}


def field_in_config(method: type[Method], key: str) -> bool:
    """Whether a dotted key is one of the method's own config."""
    from splatwizard_core.training.keys import field_at

    return field_at(method.Config, key) is not None


def resolve_run_options(
    config_file: str | None, values: dict[str, Any]
) -> tuple[PipelineParams, SceneOptions, str | None]:
    """For commands that need no method: run parameters, scene options, and the scene that the file names.

    Keys of a method in the file are passed over.
    """
    from splatwizard_core.errors import ConfigError
    from splatwizard_core.method import Method
    from splatwizard_core.runs.config import RESERVED, SCENE_KEYS, read_config_file, resolve
    from splatwizard_core.training.keys import block_keys, field_at, flatten
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
    for name in (n for n in RESERVED if not isinstance(tables.get(n, ""), str)):
        raise ConfigError(f"bad value {tables[name]!r} for '{name}' in {config_file}: expected a name", key=name)
    resolved = resolve(NoMethod, "paper", "r1", sets={**from_file, **values})
    return resolved.ppl, resolved.scene, tables.get("scene")


def metric_settings(plugins: PluginManager, values: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Take the keys `metrics.GROUP.KEY` out of `values`; returns them by group, checked."""
    from splatwizard_core.evaluation.metrics import check_settings
    from splatwizard_core.training.keys import set_at

    found: dict[str, Any] = {}
    for key in [key for key in values if key.startswith("metrics.")]:
        set_at(found, key.removeprefix("metrics."), values.pop(key))
    return check_settings(plugins.metrics, found)


def open_session(ppl: PipelineParams, plugins: PluginManager) -> Session:
    """Threads and device as asked. Raises PluginError for rasterizers that are not installed, CapabilityError."""
    from splatwizard_core.runs.device import choose_device, set_threads
    from splatwizard_core.runs.session import Session

    for name in (*ppl.raster.prefer, *ppl.raster.forbid):
        plugins.rasterizers.entry(name)
    set_threads(ppl.threads)
    return Session(plugins, choose_device(ppl.device, plugins), say)


def say_device(ppl: PipelineParams, session: Session) -> None:
    """Tell where a training computes, and why there."""
    from splatwizard_core.runs.device import device_reason

    say(device_reason(ppl.device, session.device, session.plugins))


def lpips_folder(folder: str | None, *, quiet: bool = False) -> Path | None:
    """The folder of --lpips-weights, checked before the work; says it once if LPIPS cannot be computed.

    Raises UserInputError for a folder without weights, or with damaged ones.
    """
    from sw_metrics.lpips_weights import check_folder
    from sw_metrics.perceptual import not_available

    found = None if folder is None else Path(folder).resolve()
    if found is not None:
        check_folder(found)
    warning = None if quiet else not_available(found)
    if warning is not None:
        say(f"warning: {warning}")
    return found


def existing(path: str) -> Path:
    """A path that must be there. Raises UserInputError."""
    from splatwizard_core.errors import UserInputError

    found = Path(path)
    if not found.exists():
        raise UserInputError(f"{path}: there is no such file or folder")
    return found


def existing_file(path: str) -> Path:
    """An encoded file that must be there. Raises UserInputError; of a run directory it names the file inside."""
    from splatwizard_core.errors import UserInputError

    found = existing(path)
    if found.is_dir():
        inside = found / "scene.swz"
        hint = f"the file in it is {inside}" if inside.is_file() else "name the .swz or .ply in it"
        raise UserInputError(f"{path} is a folder, and this command takes a file: {hint}")
    return found


def output_file(path: str | Path) -> Path:
    """A path that a file can be written to; asked before the work, not after it. Raises UserInputError."""
    from splatwizard_core.errors import UserInputError

    target = Path(path)
    if target.is_dir():
        raise UserInputError(f"{path} is a folder: give the name of a file in it")
    if not target.parent.is_dir():
        raise UserInputError(f"cannot write {path}: there is no folder {target.parent}")
    refused = _refused(target.parent)
    if refused is not None:
        raise UserInputError(f"cannot write {path}: {refused}")
    return target


def output_folder(path: str | Path) -> Path:
    """A folder that files can be written to, or made; asked before the work, and made by whoever writes the first file,
    so that wrong input leaves nothing behind. Raises UserInputError."""
    from splatwizard_core.errors import UserInputError

    target = Path(path)
    nearest = next(place for place in (target, *target.absolute().parents) if place.exists())
    if nearest == target and not target.is_dir():
        raise UserInputError(f"cannot write into {path}: it is a file, not a folder")
    refused = _refused(nearest)
    if refused is not None:
        raise UserInputError(f"cannot write into {path}: {refused}")
    return target


def _refused(folder: Path) -> str | None:
    """Why no file can be written into a folder that is there, found out by writing one; None if it can."""
    import tempfile

    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return f"{folder}: {error.strerror}"
    return None
