"""From the options of a command to configurations and a session."""

from __future__ import annotations

import functools
import os
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.cli.options import say
from splatwizard_core.errors import CapabilityError, ConfigError, UserInputError

TINY = 500_000  # pixels of all training pictures: the published plans take half an hour of a CPU for nothing

if TYPE_CHECKING:
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.runs.config import ResolvedConfig
    from splatwizard_core.runs.session import Session
    from splatwizard_core.scene.scene import Scene


@dataclass(frozen=True)
class Choices:
    """The options of a command that decide a configuration; those that it does not have stay None or empty."""

    methods: tuple[str, ...] = ()
    scene: str | None = None
    images: str | None = None
    split: str | None = None
    rate: str | None = None
    preset: str | None = None
    init: str | None = None
    config_file: str | None = None
    sets: tuple[str, ...] = ()
    device: str | None = None
    seed: int | None = None
    below: Mapping[str, Any] = field(default_factory=dict)  # values that hold where --set gives no other

    def values(self) -> dict[str, Any]:
        """The values of --set together with those of the options that stand for a key."""
        from splatwizard_core.runs.config import parse_set

        given: dict[str, Any] = dict(parse_set(self.sets))
        for key in ("images", "split", "device", "seed", "init"):
            if (value := getattr(self, key)) is None:
                continue
            if str(given.get(key, value)) != str(value):
                raise ConfigError(f"--{key} {value} contradicts --set {key}={given[key]}: give one of them", key=key)
            given[key] = value
        return {**{k: v for k, v in self.below.items() if k.partition(".")[0] not in given}, **given}

    def method_names(self, plugins: PluginManager) -> list[str]:
        """The methods that `--method a,b --method c` names, else the one of the configuration file, else the default.

        Raises click.UsageError that names the package to install if there is no default.
        """
        from splatwizard_core.plugins.catalogue import package_of
        from splatwizard_core.runs.config import read_config_file

        names = [name.strip() for text in self.methods for name in text.split(",") if name.strip()]
        if names:
            return list(dict.fromkeys(names))
        if self.methods:
            raise click.UsageError("--method is empty: give a name, or leave it out")
        said = (read_config_file(self.config_file) if self.config_file else {}).get("method", plugins.methods.default)
        if said is None:
            package = package_of("default", "method") or "'splatwizard-core[all]'"
            raise click.UsageError(f"no method is named, and the default one is not there: pip install {package}")
        return [said]

    def resolve(self, plugins: PluginManager) -> list[ResolvedConfig]:
        """One configuration for every method and rate point; wrong input fails before anything runs."""
        from splatwizard_core.runs.config import rate_points, resolve
        from splatwizard_core.runs.pretrained import checked_start

        values, methods = self.values(), [plugins.methods.load(name) for name in self.method_names(plugins)]
        if values.get("size") and any(len(rate_points(each, self.rate)) > 1 for each in methods if self.rate):
            told = f"--rate {self.rate} with --size {values['size']} would make one file again and again"
            raise click.UsageError(f"{told}: leave out one of the two")
        found = [
            resolve(method, self.preset, rate, self.config_file, values, scene=self.scene, plugins=plugins)
            for method in methods
            for rate in ([None] if self.rate is None else rate_points(method, self.rate))
        ]
        found = self._with_starts_alike(plugins, _without_unused_starts(plugins, found))
        return [checked_start(plugins, each) for each in found]

    def _with_starts_alike(self, plugins: PluginManager, found: list[ResolvedConfig]) -> list[ResolvedConfig]:
        """Let what --set and --config say also train the scenes that the methods start from.

        Not the file of a run: it says all of it, in a table `pretrained` of its own.
        """
        from splatwizard_core.runs.config import is_whole
        from splatwizard_core.runs.pretrained import for_starts

        of_user = {"--set"}
        if self.config_file and not is_whole(self.config_file):
            of_user.add(self.config_file)
        settled = []
        for each in found:
            given = [key for key, source in each.provenance.items() if source in of_user and key not in self.below]
            settled.append(replace(each, pretrained={**for_starts(plugins, each, given), **each.pretrained}))
        return settled

    def settled(
        self, found: list[ResolvedConfig], plugins: PluginManager, scene: Callable[[ResolvedConfig], Scene],
        tell: Callable[[str], None] = say,
    ) -> list[ResolvedConfig]:  # fmt: skip
        """Return what `resolve` found, a tiny scene with the preset "quick" where nothing says otherwise.

        scene   loads the scene of a configuration
        tell    is told of that, and of the values by data set of each method
        """
        free = self.preset is None and self.config_file is None and found[0].preset != "quick"
        if free and all("iterations" not in each.provenance for each in found):
            pixels = max(sum(view.camera.width * view.camera.height for view in scene(each).train) for each in found)
            if pixels < TINY:
                found = replace(self, preset="quick").resolve(plugins)
                why = f"the plan scaled down for {pixels:,} training pixels"
                tell(f"preset quick: {why} (--preset paper runs it in full)")
        tell_data_set_values(found, tell)
        for each in {each.method: each for each in found}.values():
            shared = [f"{k}={v}" for k, v in each.pretrained.items() if f"pretrained.{k}" not in each.provenance]
            if shared:
                told = f"{each.method}: the trained scene that it starts from has {', '.join(shared)} too"
                tell(f"{told} (--set pretrained.KEY=VALUE decides)")
        return found

    def resolve_one(self, plugins: PluginManager) -> ResolvedConfig:
        """The configuration of a command that makes one thing."""
        return only(self.resolve(plugins))

    def resolve_without_method(self) -> ResolvedConfig:
        """The configuration of a command that needs no method: how a scene is read, and the keys of a run.

        Keys of a method in the file are passed over; in `sets` they are a ConfigError.
        """
        from splatwizard_core.method import Method
        from splatwizard_core.runs.config import RESERVED, SCENE_KEYS, read_config_file, resolve
        from splatwizard_core.training.keys import block_keys, dotted, field_at, flatten
        from splatwizard_core.training.params import OptimizationParams, PipelineParams

        class NoMethod(Method):
            name = "none"

        file, values = self.config_file, self.values()
        tables = read_config_file(file) if file else {}
        for key in (k for k in values if k in OptimizationParams.model_fields):
            known = ", ".join(sorted({*SCENE_KEYS, *block_keys(PipelineParams)}))
            raise ConfigError(f"key '{key}' in --set is of no use here: one of {known}", key=key)
        from_file = dotted({"metrics": tables.pop("metrics", {})})
        for key, value in flatten(PipelineParams, tables).items():
            if key not in RESERVED and (key in SCENE_KEYS or field_at(PipelineParams, key) is not None):
                from_file[key] = value
        found = resolve(NoMethod, "paper", sets={**from_file, **values}, scene=self.scene or tables.get("scene"))
        sources = {key: str(file) for key in from_file if key not in values}
        return replace(found, provenance={**found.provenance, **sources})

    def of_file(self, path: Path, tell: Callable[[str], None] = say) -> Choices:
        """The same for what looks at a file on a scene: where none is named, that of the file's run directory, as it
        was read there.

        Raises UserInputError if nothing says whose file it is: on a default scene its numbers would be about nothing.
        """
        found = self._scene_of(path)
        if found is None:
            own = _scene_beside(path)
            if self.scene and own and os.path.realpath(own) != os.path.realpath(self.scene):
                tell(f"warning: {path} lies in a run directory of scene {own}, and is looked at on {self.scene}")
            return self
        scene, config = found
        tell(f"scene {scene}, as in the run directory that {path} lies in (--scene names another)")
        return replace(self, scene=scene, config_file=self.config_file or str(config))

    def of_start(self, tell: Callable[[str], None] = say) -> Choices:
        """The same for a training: one that starts from a file, and names no scene, is about that file's scene."""
        start = Path(str(self.values().get("init", "")))
        found = self._scene_of(start) if start.is_file() else None
        if found is None:
            return self
        tell(f"scene {found[0]}, that of the run directory that {start} lies in (--scene names another)")
        return replace(self, scene=found[0])

    def _scene_of(self, path: Path) -> tuple[str, Path] | None:
        """The scene and the config.toml of the run directory that a file lies in; None: a scene is named."""
        from splatwizard_core.runs.config import read_config_file

        if self.scene is not None or (self.config_file and "scene" in read_config_file(self.config_file)):
            return None
        if not (scene := _scene_beside(path)):
            raise UserInputError(
                f"nothing says which scene {path} is of (no config.toml of a run lies beside it): name it by --scene"
            )
        return scene, path.absolute().parent / "config.toml"

    def with_rate_of(self, directory: Path, plugins: PluginManager) -> Choices:
        """The same for a run directory: its config.toml, with what another rate point would change in it."""
        from splatwizard_core.runs.config import read_config_file, resolve
        from splatwizard_core.training.keys import dotted, field_at

        chosen = replace(self, config_file=str(directory / "config.toml"))
        if self.rate is None:
            return chosen
        (name,) = chosen.method_names(plugins)
        method = plugins.methods.load(name)
        preset = str(read_config_file(directory / "config.toml").get("preset", "paper"))
        wanted = resolve(method, preset, self.rate, plugins=plugins)
        keys = tuple(
            f"{k}." for point in method.RATES.values() for k in point if field_at(method.Config, k) is not None
        )
        found = dotted(wanted.config.model_dump()).items()
        return replace(chosen, rate=None, below={k: v for k, v in found if f"{k}.".startswith(keys)})


def tell_data_set_values(found: Sequence[ResolvedConfig], tell: Callable[[str], None] = say) -> None:
    """Tell the values by data set of each method: those of its first rate point."""
    from splatwizard_core.training.keys import dotted

    for each in reversed({each.method: each for each in reversed(found)}.values()):
        values = dotted(each.config.model_dump() | each.scene_options) | dotted(each.pretrained, "pretrained.")
        told = [f"{k} = {values[k]}" for k, source in each.provenance.items() if source.startswith("data set ")]
        if told:
            tell(f"{each.method}, by data set: {', '.join(told)}")


def only(found: Sequence[ResolvedConfig]) -> ResolvedConfig:
    """The one of them. Raises click.UsageError for several."""
    if len(found) != 1:
        raise click.UsageError("this command takes one method and one rate point; `sw run` takes several")
    return found[0]


def takes_choices(function: Callable[..., None]) -> Callable[..., None]:
    """Hand the options of a command that `Choices` knows to its function together, as the argument `chosen`."""

    @functools.wraps(function)
    def call(**given: Any) -> None:
        known = {field.name: given.pop(field.name) for field in fields(Choices) if field.name in given}
        function(chosen=Choices(**known), **given)

    return call


def _without_unused_starts(plugins: PluginManager, found: list[ResolvedConfig]) -> list[ResolvedConfig]:
    """Of several methods, take --init and `pretrained.KEY` from those that start from nothing trained."""
    from splatwizard_core.runs.pretrained import useful_starts

    nothing: dict[str, Any] = {"init": "", "pretrained": {}}
    given = [what for what in nothing if any(getattr(each, what) for each in found)]
    useful = {each.method: useful_starts(plugins, each) for each in found} if given else {}
    for what in given:
        useless = [method for method, starts in useful.items() if what not in starts]
        if len(useless) < len(useful):  # else it is wrong, and told so
            for method in useless:
                say(f"{method} does not start from a trained scene: '{what}' is for the others")
            found = [replace(each, **{what: nothing[what]}) if each.method in useless else each for each in found]
    return found


def open_session(resolved: ResolvedConfig, plugins: PluginManager) -> Session:
    """Threads and device as asked. Raises PluginError or ConfigError for a choice of rasterizers that is none here,
    CapabilityError for the device."""
    from splatwizard_core.runs.device import choose_device, set_threads
    from splatwizard_core.runs.session import Session

    ppl = resolved.ppl
    set_threads(ppl.threads)
    session = Session(plugins, choose_device(ppl.device, plugins), say)
    if ppl.raster != type(ppl.raster)():
        session.rasterizer(resolved, ())  # what is wrong with the choice is told before the work
    return session


def open_training_session(chosen: Choices, plugins: PluginManager) -> tuple[list[ResolvedConfig], Session]:
    """The configurations of trainings and their session, the scenes loaded: what is wrong with one is told first.

    Tells where they compute, and why there.
    """
    from splatwizard_core.runs.device import device_reason

    chosen = chosen.of_start()
    resolved = chosen.resolve(plugins)
    _refuse_unavailable(resolved, plugins)
    _warn_of_equal_rates(resolved)
    session = open_session(resolved[0], plugins)
    resolved = chosen.settled(resolved, plugins, session.scene)
    say(device_reason(resolved[0].ppl.device, session.device, plugins))
    return resolved, session


def _refuse_unavailable(resolved: Sequence[ResolvedConfig], plugins: PluginManager) -> None:
    """Ask the probe that a method declares as `available`, "module:function", () -> the reason why not, or None.

    Raises CapabilityError.
    """
    for entry in {each.method: plugins.methods.entry(each.method) for each in resolved}.values():
        probe = entry.declared.get("available")
        reason = pkgutil.resolve_name(probe)() if isinstance(probe, str) else None
        if reason is not None:
            raise CapabilityError(f"method '{entry.name}': {reason}")


def _warn_of_equal_rates(resolved: Sequence[ResolvedConfig]) -> None:
    """Say which rate points of a method have the same values, since --set or --config overrides what differs."""
    from splatwizard_core.runs.config import content_hash

    equal: dict[str, list[ResolvedConfig]] = {}
    for each in resolved:
        told = {k: v for k, v in each.as_dict().items() if k not in ("rate", "provenance")}
        equal.setdefault(content_hash(told), []).append(each)
    for same in (found for found in equal.values() if len(found) > 1):
        rates = ", ".join(each.rate for each in same)
        say(f"warning: {same[0].method} {rates}: these rate points give the same file, as what differs is overridden")


def warn_of_metrics(
    session: Session, names: Sequence[str] | None, settings: Any, *, geometry: bool = False, quiet: bool = False
) -> None:
    """Say before the work, once, what keeps metrics from being computed here.

    names   None: the usual ones over images; with `geometry` those over models too
    Raises UserInputError for settings that name something which is not there.
    """
    from splatwizard_core.evaluation.metrics import MetricSetup, chosen_metrics, unavailable

    entries = chosen_metrics(session.plugins.metrics, names, geometry=geometry)
    for line in unavailable(entries, MetricSetup(session.device, settings)):
        if not quiet:
            say(f"warning: {line}")


def _scene_beside(path: Path) -> str:
    """Return the scene of the run directory that a file lies in, as written there; empty: nothing says it."""
    from splatwizard_core.runs.config import read_config_file

    config = path.absolute().parent / "config.toml"
    scene = read_config_file(config).get("scene") if config.is_file() else None
    return scene if isinstance(scene, str) else ""
