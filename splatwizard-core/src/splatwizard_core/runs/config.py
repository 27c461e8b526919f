"""Configuration of a run: defaults -> preset -> rate point -> file -> --set, every key and value checked."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.files import file_sha256
from splatwizard_core.runs.keys import (
    block_keys,
    dotted,
    field_at,
    flatten,
    input_files,
    nested,
    set_at,
    suggest,
    value_at,
)
from splatwizard_core.runs.values import parse_text
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.training.params import OptimizationParams, Params, PipelineParams

if TYPE_CHECKING:
    from splatwizard_core.method import Method

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ParamsT = TypeVar("ParamsT", bound=Params)

RESERVED = ("method", "preset", "rate", "scene")
# The seed of a scene's start points is the seed of the run.
SCENE_KEYS = tuple(f.name for f in dataclasses.fields(SceneOptions) if f.name != "seed")
PRETRAINED = "pretrained."  # keys of the method whose trained scene a run starts from
INIT = "init"  # a .ply in place of that scene; a method that has a key of this name means its own
RATE_ALIASES = ("low", "default", "high", "all")
# What else stands at the top of a configuration: a method's own key of such a name would hide it. INIT may be both.
TAKEN = {*RESERVED, *SCENE_KEYS, *PipelineParams.model_fields, PRETRAINED.rstrip(".")}


def apply_overrides(config: ParamsT, values: Mapping[str, Any], *, source: str) -> ParamsT:
    """`config` with some values replaced.

    values  by dotted key; strings are parsed by the field's type ("true", "3e4", "[1, 2]", "none")
    source  where they come from, for the message: "--set", "preset 'quick'", a file name

    Raises ConfigError for an unknown key (with the nearest valid one) or a bad value.
    """
    cls = type(config)
    content = config.model_dump()
    for key, value in values.items():
        annotation = field_at(cls, key)
        if annotation is None:
            raise unknown_key(key, block_keys(cls), source)
        set_at(content, key, _parsed(annotation, key, value, source))
    try:
        return cls.model_validate(content)
    except ValidationError as error:
        raise _bad_value(error, values, source, block_keys(cls)) from None


def _parsed(annotation: Any, key: str, value: Any, source: str) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return parse_text(annotation, value)
    except ValueError as error:
        raise ConfigError(f"bad value '{value}' for '{key}' in {source}: {error}", key=key) from None


def _bad_value(
    error: ValidationError, values: Mapping[str, Any], source: str, described: Mapping[str, str]
) -> ConfigError:
    first = error.errors()[0]
    location = [str(part) for part in first["loc"]]
    # The culprit is the longest given key that the location starts with; a check over several fields has no location.
    path = ".".join(location)
    key = max((k for k in values if path == k or path.startswith(f"{k}.")), key=len, default=path)
    reason = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if not key:
        return ConfigError(f"bad combination of values in {source}: {reason}")
    value = values.get(key, first.get("input"))
    about = f" ({described[key]})" if described.get(key) else ""
    return ConfigError(f"bad value {value!r} for '{key}' in {source}: must be {reason}{about}", key=key)


def unknown_key(key: str, known: Mapping[str, str] | Sequence[str], source: str) -> ConfigError:
    """The error for a key that nothing has: it names the nearest valid one."""
    near = suggest(key, list(known))
    hint = f"did you mean '{near}'?" if near else _keys_beside(key, known)
    return ConfigError(f"unknown key '{key}' in {source}: {hint}", key=key)


def _keys_beside(key: str, known: Mapping[str, str] | Sequence[str]) -> str:
    """What there is instead: the keys of the block that it names, else those at the top."""
    block = key.rpartition(".")[0]
    inside = sorted(k for k in known if block and k.startswith(f"{block}."))
    if inside:
        return f"'{block}' has {', '.join(k.removeprefix(f'{block}.') for k in inside)}"
    return f"the keys are {', '.join(sorted({k.split('.')[0] for k in known}))}"


@dataclass(frozen=True)
class ResolvedConfig:
    """What one run is made with, every value decided.

    method, preset, rate    names
    scene_spec              "demo", a folder, or dataset/scene
    config                  the method's hyper-parameters
    ppl                     run parameters
    scene                   how the scene is read
    provenance              dotted key -> "preset 'quick'", "rate 'r2'", a file name or "--set"; absent: the default
    init                    a .ply that the run starts from in place of a trained scene; empty: none
    pretrained              values by dotted key of the method whose trained scene it starts from, and its "preset"
    """

    method: str
    preset: str
    rate: str
    scene_spec: str
    config: OptimizationParams
    ppl: PipelineParams
    scene: SceneOptions
    provenance: Mapping[str, str]
    init: str = ""
    pretrained: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values by block, None included; what the record keeps."""
        found = {
            "method": self.method,
            "preset": self.preset,
            "rate": self.rate,
            "config": self.config.model_dump(mode="json"),
            "pipeline": self.ppl.model_dump(mode="json"),
            "scene": {key: getattr(self.scene, key) for key in SCENE_KEYS},
            "provenance": dict(self.provenance),
        }
        if self.init:
            found["init"] = self.init
        if self.pretrained:
            found["pretrained"] = self._pretrained_tables()
        return found

    def _pretrained_tables(self) -> dict[str, Any]:
        tables: dict[str, Any] = {}
        for key, value in self.pretrained.items():
            set_at(tables, key, value)
        return tables

    def toml(self) -> str:
        """A file that makes the same run again when given as `--config`."""
        import tomli_w

        content: dict[str, Any] = {"method": self.method, "preset": self.preset, "rate": self.rate}
        content["scene"] = absolute_spec(self.scene_spec)
        # The blocks are merged upwards: no two have a key in common (`check_own_keys`), or INIT is the method's own.
        content |= {key: getattr(self.scene, key) for key in SCENE_KEYS}
        content |= self.ppl.model_dump(mode="json")
        config = self.config.model_dump(mode="json")
        for key, path in self._input_files().items():
            set_at(config, key, os.path.abspath(path))
        if self.init:
            content[INIT] = os.path.abspath(self.init)
        if self.pretrained:
            content["pretrained"] = self._pretrained_tables()
        content |= config
        return tomli_w.dumps(_spell_none(content))

    def training_content(self) -> dict[str, Any]:
        """Everything that training depends on: not the `ENCODING` fields, the device or the rate's name.

        A file that it reads counts by what it holds. What it starts from is told apart (`experiments.start`).
        """
        config = self.config_content()
        for name in type(self.config).ENCODING:
            config.pop(name, None)
        run = self.ppl.model_dump(mode="json", include={"seed", "random_background", "clamp_render", "raster"})
        return {
            "method": self.method,
            "config": config,
            "pipeline": run,
            "scene": {key: getattr(self.scene, key) for key in SCENE_KEYS},
        }

    def config_content(self) -> dict[str, Any]:
        """The method's hyper-parameters, with what its input files hold in place of where they lie."""
        config = self.config.model_dump(mode="json")
        for key, digest in self._input_digests.items():
            set_at(config, key, digest)
        return config

    def _input_files(self) -> dict[str, str]:
        """Dotted key of the config -> path, of those that are given and are a file."""
        paths = {key: str(value_at(self.config, key)) for key in input_files(type(self.config))}
        return {key: path for key, path in paths.items() if path and os.path.isfile(path)}

    @functools.cached_property
    def _input_digests(self) -> dict[str, str]:
        return {key: f"sha256 {file_sha256(Path(path))}" for key, path in self._input_files().items()}

    def training_hash(self) -> str:
        """SHA-256 of `training_content`: rate points that differ in the codec alone share it."""
        return content_hash(self.training_content())

    def config_hash(self) -> str:
        """SHA-256 over every value of the method, the run and the scene options."""
        content = self.as_dict()
        del content["provenance"]
        return content_hash(content)


def is_demo(scene_spec: str) -> bool:
    """Whether a scene is the procedural one."""
    return scene_spec == "demo" or scene_spec.startswith("demo:")


def absolute_spec(scene_spec: str) -> str:
    """A scene as another process, with another working directory, can find it."""
    return str(Path(scene_spec).resolve()) if not is_demo(scene_spec) and Path(scene_spec).exists() else scene_spec


def content_hash(content: Any) -> str:
    """SHA-256 over JSON with sorted keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def _spell_none(value: Any) -> Any:
    """TOML has no null; the word "none" is parsed back by the field's type."""
    if value is None:
        return "none"
    if isinstance(value, Mapping):
        return {k: _spell_none(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_spell_none(v) for v in value]
    return value


def check_own_keys(method: type[Method]) -> None:
    """Raise PluginError for a method whose Config has a key that a run needs itself, such as its rate point's name."""
    clashing = [key for key in method.Config.model_fields if key in TAKEN]
    if clashing:
        names = " and ".join(f"'{key}'" for key in clashing)
        raise PluginError(
            f"method '{method.name}' cannot be used: its {method.Config.__name__} ({method.Config.__module__}) has a "
            f"key {names}, as every run has; its author must choose another name"
        )


def rate_points(method: type[Method], asked: str) -> list[str]:
    """The rate points that "r1,r3", "low", "default", "high" or "all" mean, in the method's order."""
    names = list(method.RATES)
    aliases = {"low": [names[0]], "high": [names[-1]], "default": [method.DEFAULT_RATE], "all": names}
    found: list[str] = []
    for word in (w.strip() for w in asked.split(",")):
        if word in aliases:
            found += aliases[word]
        elif word in names:
            found.append(word)
        else:
            raise ConfigError(
                f"method '{method.name}' has no rate point '{word}': "
                f"one of {', '.join(names)}, or {', '.join(RATE_ALIASES)}",
                key="rate",
            )
    return sorted(set(found), key=names.index)


def read_config_file(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises ConfigError that names the line."""
    try:
        with open(path, "rb") as file:
            tables: dict[str, Any] = tomllib.load(file)
            return tables
    except OSError as error:
        raise ConfigError(f"cannot read --config {path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def parse_set(assignments: Sequence[str]) -> dict[str, str]:
    """`["a.b=1", ...]` -> {"a.b": "1", ...}; a later one wins."""
    values: dict[str, str] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set needs key=value, got '{text}'")
        values[key.strip()] = value.strip()
    return values


def resolve(
    method: type[Method],
    preset: str | None = None,
    rate: str | None = None,
    config_file: str | Path | None = None,
    sets: Mapping[str, Any] | None = None,
    *,
    scene: str | None = None,
) -> ResolvedConfig:
    """Every value of a run of `method`: defaults -> preset -> rate point -> file -> sets, the later wins.

    preset, rate    names; None: what the file says, else "quick" on the demo scene and "paper" elsewhere, and the
                    method's DEFAULT_RATE
    config_file     TOML; keys as in `sets`, tables for blocks, besides the reserved `method`, `preset`, `rate`, `scene`
    sets            by dotted key: a key of the method's config, else of PipelineParams, else a scene option, else
                    `init` or `pretrained.KEY`, which `experiments.start.settled` checks
    scene           "demo", a folder, or dataset/scene; None: what the file says, else "demo"

    Raises ConfigError, and PluginError for a method whose Config has keys that belong to the run.
    """
    check_own_keys(method)
    tables = read_config_file(config_file) if config_file is not None else {}
    said = {name: tables.pop(name) for name in RESERVED if name in tables}
    for name, value in said.items():
        if not isinstance(value, str) or not value.strip():
            raise ConfigError(f"bad value {value!r} for '{name}' in {config_file}: expected a name", key=name)
    for name, asked in (("preset", preset), ("rate", rate), ("scene", scene)):
        if asked is not None and not asked.strip():
            raise ConfigError(f"--{name} is empty: give a name, or leave it out", key=name)
    for name, asked in (("method", method.name), ("preset", preset), ("rate", rate)):
        if asked is not None and said.get(name, asked) != asked:
            raise ConfigError(
                f"{config_file} was written for {name} '{said[name]}', not '{asked}': "
                f"leave out --{name}, or take the key '{name}' and the values that follow from it out of the file",
                key=name,
            )
    scene_spec = scene or str(said.get("scene", "demo"))
    preset = preset or said.get("preset") or ("quick" if is_demo(scene_spec) else "paper")
    rate = rate or said.get("rate") or method.DEFAULT_RATE
    if preset not in method.PRESETS:
        raise ConfigError(
            f"method '{method.name}' has no preset '{preset}': one of {', '.join(method.PRESETS)}", key="preset"
        )
    points = rate_points(method, rate)
    if len(points) != 1:
        raise ConfigError(f"one rate point is needed here, not '{rate}'", key="rate")
    (rate,) = points

    layers: list[tuple[str, Mapping[str, Any]]] = [
        (f"preset '{preset}'", method.PRESETS[preset]),
        (f"rate '{rate}'", method.RATES[rate]),
        (str(config_file), flatten(method.Config, flatten(PipelineParams, tables))),
        ("--set", sets or {}),
    ]
    config: OptimizationParams = method.Config()
    init, pretrained = "", dict[str, Any]()
    ppl, scene_options = PipelineParams(), SceneOptions()
    known = {**dict.fromkeys(SCENE_KEYS, ""), **block_keys(PipelineParams), **block_keys(method.Config)}
    provenance: dict[str, str] = {}
    for source, layer in layers:
        values = _with_dotted_tables(layer)
        parts: tuple[dict[str, Any], dict[str, Any], dict[str, Any]] = ({}, {}, {})
        for key, value in values.items():
            if field_at(method.Config, key) is not None:
                parts[0][key] = value
            elif field_at(PipelineParams, key) is not None:
                parts[1][key] = value
            elif key in SCENE_KEYS:
                parts[2][key] = value
            elif key == INIT and isinstance(value, str):
                init = value
            elif key.startswith(PRETRAINED) and key != PRETRAINED:
                pretrained[key.removeprefix(PRETRAINED)] = value
            else:
                raise unknown_key(key, known, source)
            provenance[key] = source
        config = apply_overrides(config, parts[0], source=source)
        ppl = apply_overrides(ppl, parts[1], source=source)
        scene_options = _scene_options(scene_options, parts[2], source)
    scene_options = dataclasses.replace(scene_options, seed=ppl.seed)
    return ResolvedConfig(
        method.name, preset, rate, scene_spec, config, ppl, scene_options, provenance, init, pretrained
    )


def _with_dotted_tables(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values, the table `pretrained` of a file as dotted keys."""
    found = dict(values)
    table = found.get(PRETRAINED.rstrip("."))
    if isinstance(table, Mapping):
        del found[PRETRAINED.rstrip(".")]
        found |= dotted(table, PRETRAINED)
    return found


def _scene_options(options: SceneOptions, values: Mapping[str, Any], source: str) -> SceneOptions:
    hints = {f.name: TypeAdapter(nested(SceneOptions, f.name)) for f in dataclasses.fields(SceneOptions)}
    changed = {}
    for key, value in values.items():
        parsed = _parsed(nested(SceneOptions, key), key, value, source)
        try:
            changed[key] = hints[key].validate_python(parsed)
        except ValidationError as error:
            raise _bad_value(error, {key: value}, source, {}) from None
    return dataclasses.replace(options, **changed)
