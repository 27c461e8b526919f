"""Configuration of a run: defaults -> preset -> data set -> rate point -> file -> --set, all checked."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from splatwizard_core.base.files import file_sha256
from splatwizard_core.base.toml_file import read_toml
from splatwizard_core.base.warned import warn_once
from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.evaluation.metrics import MetricSettings, check_settings
from splatwizard_core.plugins.manager import PluginManager, load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import family_of
from splatwizard_core.scene.locate import is_procedural
from splatwizard_core.training.identity import DEFAULTS, all_values, given_values
from splatwizard_core.training.keys import block_keys, dotted, field_at, flatten, input_files, set_at, value_at
from splatwizard_core.training.overrides import apply_overrides, unknown_key
from splatwizard_core.training.params import OptimizationParams, Params, PipelineParams, SceneParams

if TYPE_CHECKING:
    from splatwizard_core.method import Method

RESERVED = ("method", "preset", "rate", "scene")
OF_RUN = {*RESERVED, "seed", "threads", "log_every", "test_every"}  # all that a run writes, and hardly a person
SCENE_KEYS = tuple(SceneParams.model_fields)
PRETRAINED = "pretrained."  # keys of the method whose trained scene a run starts from
USUAL_SOURCES = ("preset '", "data set '", "rate '")  # how the provenance of what the method itself says begins
METRICS = "metrics."  # keys of the settings of metrics: metrics.GROUP.KEY
INIT = "init"  # a .ply in place of that scene; a method that has a key of this name means its own
TABLES = ("pretrained", "metrics")
# What else stands at the top of a configuration: a method's own key of such a name would hide it. INIT may be both.
TAKEN = {*RESERVED, *SCENE_KEYS, *PipelineParams.model_fields, *TABLES}


@dataclass(frozen=True)
class ResolvedConfig:
    """Every value that one run is made with.

    method, preset, rate    names
    scene_spec              a folder, dataset/scene, or the name of a procedural scene
    config                  the method's hyper-parameters
    ppl                     run parameters
    scene                   how the scene is read
    given                   the method's hyper-parameters that differ from their defaults (`training.identity`)
    provenance              dotted key -> "preset 'quick'", "data set 'db'", "rate 'r2'", a file, "--set"; else default
    init                    a .ply that the run starts from in place of a trained scene; empty: none
    pretrained              values by dotted key of the method whose trained scene it starts from, and its "preset"
    metrics                 settings of metrics, group -> key -> value
    procedural              whether the scene is made on the spot
    """

    method: str
    preset: str
    rate: str
    scene_spec: str
    config: OptimizationParams
    ppl: PipelineParams
    scene: SceneOptions
    given: Mapping[str, Any]
    provenance: Mapping[str, str]
    init: str = ""
    pretrained: Mapping[str, Any] = field(default_factory=dict)
    metrics: MetricSettings = field(default_factory=dict)
    procedural: bool = False

    @property
    def scene_options(self) -> dict[str, Any]:
        """Values of the scene keys; the seed is the run's."""
        return {key: getattr(self.scene, key) for key in SCENE_KEYS}

    @property
    def absolute_scene(self) -> str:
        """The scene as another process, with another working directory, can find it."""
        is_path = not self.procedural and Path(self.scene_spec).exists()
        return str(Path(self.scene_spec).resolve()) if is_path else self.scene_spec

    def is_of_run(self, key: str) -> bool:
        """Whether a key has its value from the config.toml of a run."""
        source = self.provenance.get(key, "")
        return source.endswith(".toml") and os.path.isfile(source) and is_whole(source)

    def is_usual(self, key: str) -> bool:
        """Whether a key has its value from the method's preset, data set or rate point, not from the user."""
        return self.provenance.get(key, "").startswith(USUAL_SOURCES)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values by block, None included, as the record keeps them."""
        return {
            "method": self.method,
            "preset": self.preset,
            "rate": self.rate,
            "config": self.config.model_dump(mode="json"),
            "pipeline": self.ppl.model_dump(mode="json"),
            "scene": self.scene_options,
            "provenance": dict(self.provenance),
            **self._beside_blocks(self.init),
        }

    def _beside_blocks(self, init: str) -> dict[str, Any]:
        """Return what no block holds, of that which is given."""
        pretrained: dict[str, Any] = {}
        for key, value in self.pretrained.items():
            set_at(pretrained, key, value)
        found = {INIT: init, "pretrained": pretrained, "metrics": dict(self.metrics)}
        return {name: value for name, value in found.items() if value}

    def toml(self) -> str:
        """Return a file that makes the same run again when given as `--config`."""
        import tomli_w

        content: dict[str, Any] = {"method": self.method, "preset": self.preset, "rate": self.rate}
        content["scene"] = self.absolute_scene
        # The blocks are merged upwards: no two have a key in common (`check_own_keys`), or INIT is the method's own.
        content |= self.scene_options | self.ppl.model_dump(mode="json")
        config = self.config.model_dump(mode="json")
        for key, path in self._input_files().items():
            set_at(config, key, os.path.abspath(path))
        content |= self._beside_blocks(os.path.abspath(self.init) if self.init else "")
        return tomli_w.dumps(_spell_none(content | config))

    def training_content(self) -> dict[str, Any]:
        """Return the given values that training depends on: not the `ENCODING` fields, the device or the rate's name.

        A file that it reads counts by what it holds. What it starts from is told apart (`runs.identity`).
        """
        encoding = type(self.config).ENCODING
        config = {key: value for key, value in self.config_content().items() if key not in encoding}
        changes = {k: n for k, n in config.pop(DEFAULTS, {}).items() if k.partition(".")[0] not in encoding}
        if changes:
            config[DEFAULTS] = changes
        return self._beside_config(given_values, config)

    def training_values(self) -> dict[str, Any]:
        """Return what `training_content` does with the values that are defaults, for messages about what differs."""
        values = {k: v for k, v in all_values(self.config).items() if k not in type(self.config).ENCODING}
        return self._beside_config(all_values, self._by_content(values))

    def _beside_config(self, values: Callable[[Params], dict[str, Any]], config: dict[str, Any]) -> dict[str, Any]:
        return {"method": self.method, "config": config, "pipeline": values(self.ppl), "scene": values(self._reading)}

    @functools.cached_property
    def _reading(self) -> SceneParams:
        """The scene options, with what a file of names holds in place of where it lies."""
        split = self.scene.split
        told = f"sha256 {file_sha256(Path(split))}" if _is_list(split) else split
        return SceneParams(**{**self.scene_options, "split": told})

    def config_content(self) -> dict[str, Any]:
        """Return the given hyper-parameters, with what input files hold in place of where they lie."""
        return self._by_content(copy.deepcopy(dict(self.given)))

    def _by_content(self, config: dict[str, Any]) -> dict[str, Any]:
        for key, digest in self._input_digests.items():
            set_at(config, key, digest)
        return config

    def _input_files(self) -> dict[str, str]:
        """Return dotted key of the config -> path, of those that are given and are a file."""
        paths = {key: str(value_at(self.config, key)) for key in input_files(type(self.config))}
        return {key: path for key, path in paths.items() if path and os.path.isfile(path)}

    @functools.cached_property
    def _input_digests(self) -> dict[str, str]:
        return {key: f"sha256 {file_sha256(Path(path))}" for key, path in self._input_files().items()}

    def training_hash(self) -> str:
        """Return the SHA-256 of `training_content`: rate points that differ in the codec alone share it."""
        return content_hash(self.training_content())

    def config_hash(self) -> str:
        """Return the SHA-256 over every given value of the method, the run and the scene options.

        Settings of metrics are left out: what a metric's values depend on is the metric's to tell.
        """
        content = {
            "method": self.method, "preset": self.preset, "rate": self.rate, "config": self.given,
            "pipeline": self.ppl.model_dump(mode="json", exclude_defaults=True),
            "scene": given_values(self._reading), **self._beside_blocks(self.init),
        }  # fmt: skip
        content.pop("metrics", None)
        return content_hash(content)


def _is_list(split: str | None) -> TypeGuard[str]:
    """Whether a split is a file of names; one that has the name of a rule is not meant."""
    return split is not None and split not in ("all", "file") and os.path.isfile(split)


def content_hash(content: Any) -> str:
    """Return the SHA-256 over JSON with sorted keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def _spell_none(value: Any) -> Any:
    """Replace None, which TOML does not have, by the word "none", which is parsed back by the field's type."""
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
    """Return the rate points that "r1,r3", "low", "default", "high" or "all" mean, in the method's order."""
    names = list(method.RATES)
    aliases = {"low": [names[0]], "default": [method.DEFAULT_RATE], "high": [names[-1]], "all": names}
    found: list[str] = []
    for word in (w.strip() for w in asked.split(",")):
        if word not in aliases and word not in names:
            raise ConfigError(
                f"method '{method.name}' has no rate point '{word}': "
                f"one of {', '.join(names)}, or {', '.join(aliases)}",
                key="rate",
            )
        found += aliases.get(word, [word])
    return sorted(set(found), key=names.index)


def read_config_file(path: str | Path) -> dict[str, Any]:
    """Read the tables of a TOML file, its names checked. Raises ConfigError that names the line or the key."""
    tables, _ = read_toml(path, "--config")
    for name in RESERVED:
        value = tables.get(name, "a name")
        if not isinstance(value, str) or not value.strip():
            raise ConfigError(f"bad value {value!r} for '{name}' in {path}: expected a name", key=name)
    return tables


def is_whole(path: str | Path) -> bool:
    """Whether a file is the config.toml of a run, which says everything."""
    return set(read_config_file(path)) >= OF_RUN


def parse_set(assignments: Sequence[str]) -> dict[str, str]:
    """Split `["a.b=1", ...]` into {"a.b": "1", ...}; a later one wins."""
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
    plugins: PluginManager | None = None,
) -> ResolvedConfig:
    """Decide every value of a run: defaults -> preset -> data set -> rate point -> file -> sets, the later wins.

    preset, rate    names; None: what the file says, else "quick" on a procedural scene and "paper" elsewhere, and the
                    method's DEFAULT_RATE
    config_file     TOML; keys as in `sets`, tables for blocks, besides the reserved `method`, `preset`, `rate`, `scene`
    sets            by dotted key: a key of the method's config, else of PipelineParams, else a scene option, else
                    `metrics.GROUP.KEY`, `init` or `pretrained.KEY`; the last two `pretrained.checked_start` checks
    scene           a folder, dataset/scene or a procedural scene; None: what the file says, else the default dataset
    plugins         which scenes are procedural and which settings metrics have; None: those installed

    Raises ConfigError, and PluginError for a method whose Config has keys that belong to the run.
    """
    check_own_keys(method)
    plugins = plugins or load_plugins()
    tables = read_config_file(config_file) if config_file is not None else {}
    whole, said = set(tables) >= OF_RUN, {name: tables.pop(name) for name in RESERVED if name in tables}
    _check_names(said, config_file, method=method.name, preset=preset, rate=rate, scene=scene)
    tables |= dotted({name: tables.pop(name) for name in TABLES if name in tables})
    scene_spec = scene or said.get("scene") or plugins.datasets.default or ""
    procedural = is_procedural(plugins.datasets, scene_spec.partition(":")[0])
    preset = preset or said.get("preset") or ("quick" if procedural else "paper")
    if preset not in method.PRESETS:
        raise ConfigError(
            f"method '{method.name}' has no preset '{preset}': one of {', '.join(method.PRESETS)}", key="preset"
        )
    asked = rate or said.get("rate") or method.DEFAULT_RATE
    rate, *others = rate_points(method, asked)
    if others:
        raise ConfigError(f"one rate point is needed here, not '{asked}'", key="rate")

    family = family_of(scene_spec, plugins.datasets) if preset == "paper" and method.BY_DATASET else None
    config, ppl, reading = method.Config(), PipelineParams(), SceneParams()
    init, provenance, pretrained, settings = "", dict[str, str](), dict[str, Any](), dict[str, Any]()
    for source, layer in (
        (f"{USUAL_SOURCES[0]}{preset}'", method.PRESETS[preset]),
        (f"{USUAL_SOURCES[1]}{family}'", method.BY_DATASET.get(family or "", {})),
        (f"{USUAL_SOURCES[2]}{rate}'", method.RATES[rate]),
        (str(config_file), flatten(method.Config, flatten(PipelineParams, tables))),
        ("--set", sets or {}),
    )[3 * whole :]:  # what the file of a run lacks is newer, and has its default: the presets of then meant that
        given_keys, layer = dict(layer), config.spelled(layer)
        if source == "--set" or source == str(config_file):
            _tell_older(method.Config, given_keys, layer, source)
        given: dict[type[Params], dict[str, Any]] = {method.Config: {}, PipelineParams: {}, SceneParams: {}}
        for key, value in layer.items():
            block = next((block for block in given if field_at(block, key) is not None), None)
            if block is not None:
                given[block][key] = value
            elif key == INIT and isinstance(value, str):
                init = value
            elif key.startswith(PRETRAINED) and key != PRETRAINED:
                pretrained[key.removeprefix(PRETRAINED)] = value
            elif key.startswith(METRICS) and key.count(".") > 1:
                set_at(settings, key.removeprefix(METRICS), value)
            else:
                if key in ("size", "gaussians"):  # options of `sw run`, which only some methods take
                    able = sorted(e.name for e in plugins.methods if not e.foreign and field_at(e.load().Config, key))
                    why = getattr(method.Config, "REFUSES", {}).get(key, f"unlike {', '.join(able)}")
                    raise ConfigError(f"method '{method.name}' takes no {key}: {why}", key=key)
                known = [k for block in reversed(given) for k in block_keys(block)]
                raise unknown_key(key, [*known, *config.settings_keys(plugins)], source)
            provenance[key] = source
        config = apply_overrides(config, given[method.Config], source=source)
        ppl = apply_overrides(ppl, given[PipelineParams], source=source)
        reading = apply_overrides(reading, given[SceneParams], source=source)
    config = config.completed(plugins, provenance)
    reading_values = reading.model_dump()
    split = os.path.expanduser(reading_values["split"] or "")
    if _is_list(split):
        reading_values["split"] = os.path.abspath(split)  # other processes have other folders
    scene_options = SceneOptions(**reading_values, seed=ppl.seed)
    return ResolvedConfig(
        method.name, preset, rate, scene_spec, config, ppl, scene_options, given_values(config, plugins), provenance,
        init, pretrained,
        check_settings(plugins.metrics, settings) if settings else {}, procedural,
    )  # fmt: skip


def _tell_older(config: type[Params], given: Mapping[str, Any], today: Mapping[str, Any], source: str) -> None:
    older = [key for key in given if key not in today and field_at(config, key) is None]
    newer = ", ".join(key for key in today if key not in given) or "nothing"
    if older:
        warn_once(f"{source}: {', '.join(older)} of release 0.2 is now {newer} (docs/migration.md)")


def _check_names(said: Mapping[str, str], config_file: str | Path | None, **asked: str | None) -> None:
    """Raise ConfigError for empty options, and for a file that was written for others than they ask for."""
    for name, option in asked.items():
        if option is None:
            continue
        if not option.strip():
            raise ConfigError(f"--{name} is empty: give a name, or leave it out", key=name)
        if name != "scene" and said.get(name, option) != option:
            raise ConfigError(
                f"{config_file} was written for {name} '{said[name]}', not '{option}': "
                f"leave out --{name}, or take the key '{name}' and the values that follow from it out of the file",
                key=name,
            )
