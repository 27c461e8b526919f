"""The runs of a plan, and the processes that make them: rate points of one training share a process."""

from __future__ import annotations

import functools
import hashlib
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatwizard_core.api import ConfigError, UserInputError
from splatwizard_core.tooling import (
    Choices,
    PluginManager,
    ResolvedConfig,
    RunRequest,
    base_config,
    dotted,
    first_scene,
    load_scene,
    make_method,
    named_scenes,
    run_directory,
    say,
    useful_starts,
    write_atomic,
)
from sw_bench.plan import Plan, set_words

SHARED = ".shared"  # in the output folder: configurations of what is trained once for several runs
TRAINED = ".trained"  # of the core, in each root: trained scenes


@dataclass(frozen=True)
class Layout:
    """Places of the runs below the output folder.

    seed_folders    each seed has a root of its own, OUT/seed-N; False: the runs of the only seed lie in OUT itself
    """

    out: Path
    seed_folders: bool = True

    def root(self, seed: int, variant: str = "") -> Path:
        """Return `--out` of a seed's runs; those of a variant of a method must not share a folder with the method's."""
        name = "-".join([*([f"seed-{seed}"] if self.seed_folders else []), *([variant] if variant else [])])
        return self.out / name if name else self.out


@dataclass(frozen=True, eq=False)
class Cell:
    """One run of the plan: a method on a scene with a seed at a rate point.

    label       the plan's name of the method
    scene       as the plan spells it
    resolved    every value of the run
    root        `--out` of its run
    words       options of `sw run` that make it, but for the rate point
    """

    label: str
    scene: str
    resolved: ResolvedConfig
    root: Path
    words: tuple[str, ...]

    @property
    def seed(self) -> int:
        return self.resolved.ppl.seed

    @property
    def rate(self) -> str:
        return self.resolved.rate

    @property
    def key(self) -> tuple[str, str, int, str]:
        """Primary key in the index."""
        return self.label, self.scene, self.seed, self.rate

    @property
    def name(self) -> str:
        return f"{self.label} {self.scene} seed {self.seed} {self.rate}"

    @functools.cached_property
    def directory(self) -> Path:
        """Its run directory."""
        return run_directory(RunRequest(self.resolved, self.root))

    @functools.cached_property
    def training(self) -> str:
        """Key of its training, but for what the files of the scene hold."""
        return training_key(self.resolved)


@dataclass(frozen=True)
class SharedTraining:
    """A training that several jobs start from.

    file        its configuration, for the process that trains it; beside it lies a note where it is, once it is done
    root        its trained scene lies in ROOT/.trained
    """

    file: Path
    root: Path
    resolved: ResolvedConfig

    @property
    def note(self) -> Path:
        return self.file.with_suffix(".json")


@dataclass(eq=False)
class Job:
    """One process: `sw run` of cells that share a training, or a training that several jobs start from.

    name        for people, and for the file of its output
    words       of `sw`
    needs       jobs that must have ended well before
    about       label and scene, for estimates
    trains      its training is not one that it needs
    attempts    starts so far
    """

    name: str
    words: tuple[str, ...]
    cells: tuple[Cell, ...] = ()
    needs: tuple[Job, ...] = ()
    shared: SharedTraining | None = None
    attempts: int = 0
    about: tuple[str, str] = ("", "")
    trains: bool = True

    @property
    def log(self) -> str:
        """File name of its output."""
        return "".join(c if c.isalnum() or c in "-_.,+" else "_" for c in self.name) + ".log"


def training_key(resolved: ResolvedConfig) -> str:
    """Return a key that is equal for equal trainings on the same scene, as the plan names it."""
    start = repr((resolved.init, resolved.preset, sorted(resolved.pretrained.items())))  # of what it may start from
    told = f"{resolved.training_hash()} {resolved.absolute_scene} {start}"
    return hashlib.sha256(told.encode()).hexdigest()[:16]


def cells_of(plan: Plan, layout: Layout, plugins: PluginManager) -> list[Cell]:
    """Resolve every run of a plan; wrong input fails here, before anything runs.

    Raises UserInputError that names the run; ConfigError for a plan without any run, or with two of one directory.
    """
    found: list[Cell] = []
    load, told = _load_once(plugins), list[str]()
    for seed in plan.seeds:
        for label in plan.methods:
            for scene in plan.scenes:
                try:
                    found += _resolved(plan, label, scene, seed, layout, plugins, load, told.append)
                except UserInputError as error:
                    raise type(error)(f"{label} on {scene}: {error}") from None
    if not found:
        raise ConfigError("the plan leaves no run: every one is skipped")
    clashing = [each for each, count in Counter(cell.directory for cell in found).items() if count > 1]
    if clashing:
        scenes = " and ".join(dict.fromkeys(f"'{c.scene}'" for c in found if c.directory == clashing[0]))
        raise ConfigError(f"scenes {scenes} would share the folder {clashing[0]}: give each a plan of its own")
    for line in dict.fromkeys(told):
        say(line)
    return found


def _load_once(plugins: PluginManager) -> Callable[[ResolvedConfig], Any]:
    """Make a function that loads the scene of a configuration, the same for all seeds."""
    loaded: dict[tuple[str, str], Any] = {}

    def load(resolved: ResolvedConfig) -> Any:
        key = resolved.scene_spec, repr(replace(resolved.scene, seed=0))
        if key not in loaded:
            loaded[key] = load_scene(resolved.scene_spec, resolved.scene, plugins)
        return loaded[key]

    return load


def _resolved(
    plan: Plan,
    label: str,
    scene: str,
    seed: int,
    layout: Layout,
    plugins: PluginManager,
    load: Callable[[ResolvedConfig], Any],
    tell: Callable[[str], None],
) -> list[Cell]:
    """Resolve the rate points of one method on one scene with one seed."""
    values = plan.values_for(label, scene, seed)
    if values is None:
        return []
    method = plan.method_of(label)
    given, init = dict(values.set), plan.init
    everywhere = {key for key, value in plan.set.items() if given.get(key) == value}
    choices = Choices(
        methods=(method,), scene=scene, images=values.images, rate=values.rates, preset=values.preset,
        device=plan.device, seed=seed, config_file=None if plan.config is None else os.path.abspath(plan.config),
    )  # fmt: skip
    useful = useful_starts(plugins, choices.resolve(plugins)[0])
    if "pretrained" not in useful:  # said for all methods, it is for those that start from a trained scene
        given = {k: v for k, v in given.items() if not (k.startswith("pretrained.") and k in everywhere)}
    if "init" not in useful and "init" not in plugins.methods.load(method).Config.model_fields:
        init = None
    if init is not None and os.path.exists(init):
        init = os.path.abspath(init)  # processes on other machines have other working directories
    choices = replace(choices, sets=tuple(set_words(given)), init=init)
    resolved = choices.settled(choices.resolve(plugins), plugins, load, tell)
    for each in resolved:
        load(each)  # it must be there
    root = layout.root(seed, "" if label == method else label)
    words = [
        "--method", method, "--preset", resolved[0].preset,
        *(part for option in ("images", "device", "init", "config_file")
          if (text := getattr(choices, option)) is not None for part in (f"--{option.removesuffix('_file')}", text)),
        "--seed", str(seed), "--repeats", str(plan.repeats), *(["--geometry"] * plan.geometry),
        *(part for text in choices.sets for part in ("--set", text)),
    ]  # fmt: skip
    return [
        Cell(label, scene, each, root, ("--scene", each.absolute_scene, *words, "--out", str(root)))
        for each in resolved
    ]


def jobs_of(cells: Sequence[Cell], layout: Layout, plugins: PluginManager) -> list[Job]:
    """Put unfinished cells into processes, what others need first; a training that several need is a job of its own."""
    groups: dict[tuple[object, ...], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.root, cell.label, cell.scene, cell.training), []).append(cell)
    wanted: dict[tuple[int, str], list[ResolvedConfig]] = {}
    needs: list[list[tuple[int, str]]] = []
    for group in groups.values():
        first = group[0].resolved
        trainings = [*_bases(first, plugins), first]
        keys = [(first.ppl.seed, training_key(each)) for each in trainings]
        for key, each in zip(keys, trainings, strict=True):
            wanted.setdefault(key, []).append(each)
        needs.append(keys)
    shared = {key: _shared_job(key, who[0], layout) for key, who in wanted.items() if len(who) > 1}
    for name, count in Counter(job.name for job in shared.values()).items():
        if count > 1:  # a job goes by its name
            for number, job in enumerate([job for job in shared.values() if job.name == name], 1):
                job.name = f"{name} {number} of {count}"
    for key, job in shared.items():
        bases = [(key[0], training_key(each)) for each in _bases(wanted[key][0], plugins)]
        job.needs = tuple(shared[each] for each in bases if each in shared)
    made = []
    for group, keys in zip(groups.values(), needs, strict=True):
        job = run_job(group)
        job.needs = tuple(shared[key] for key in keys if key in shared)
        job.trains = keys[-1] not in shared
        made.append(job)
    return [*shared.values(), *made]


def run_job(cells: Sequence[Cell]) -> Job:
    """Make the job of cells that share a training."""
    first = cells[0]
    rates = ",".join(cell.rate for cell in cells)
    name = f"{first.label} {first.scene} seed {first.seed} {rates}"
    words = ("run", *first.words, "--rate", rates)
    return Job(name, words, tuple(cells), about=(first.label, first.scene))


def _bases(resolved: ResolvedConfig, plugins: PluginManager) -> list[ResolvedConfig]:
    """Return the configurations of the trained scenes that a training starts from."""
    method = make_method(plugins, resolved)
    first = first_scene(method) if resolved.init else None
    return [base_config(plugins, name, resolved) for name in named_scenes(method) if name != first]


def differing_bases(cells: Sequence[Cell], plugins: PluginManager) -> list[str]:
    """Tell where runs of one scene and seed start from, or are, differently trained scenes of one method."""
    found: dict[tuple[str, str, int], dict[str, list[tuple[Cell, ResolvedConfig]]]] = {}
    for cell in {(cell.label, cell.scene, cell.seed): cell for cell in reversed(cells)}.values():
        for each in [cell.resolved, *_bases(cell.resolved, plugins)]:
            place = found.setdefault((each.method, cell.scene, cell.seed), {})
            place.setdefault(training_key(each), []).append((cell, each))
    lines: dict[str, None] = {}
    for (method, scene, _), trainings in found.items():
        if len(trainings) < 2 or all(each.method == cell.resolved.method for group in trainings.values()
                                     for cell, each in group):  # fmt: skip
            continue  # variants of one method differ on purpose
        values = [_flat(group[0][1]) for group in trainings.values()]
        keys = [key for key in values[0] if len({repr(each.get(key)) for each in values}) > 1][:3]
        told = "; ".join(
            f"{', '.join(f'{key}={own[key]}' for key in keys if key in own)} for {', '.join(c.label for c, _ in group)}"
            for own, group in zip(values, trainings.values(), strict=True)
        )
        lines[f"{scene}: the trained {method} scenes differ: {told}"] = None
    return list(lines)


def _flat(resolved: ResolvedConfig) -> dict[str, Any]:
    """Return the values that its training reads, by dotted key."""
    values = resolved.config.model_dump(mode="json")
    return dotted({key: value for key, value in values.items() if key not in type(resolved.config).ENCODING})


def _shared_job(key: tuple[int, str], resolved: ResolvedConfig, layout: Layout) -> Job:
    """Make the job that trains a scene into the root of its seed."""
    seed, digest = key
    file, root = layout.out / SHARED / f"{digest}.toml", layout.root(seed)
    scene = resolved.absolute_scene
    return Job(
        f"{resolved.method} {Path(scene).name} seed {seed} (training for several)",
        ("bench", "--train-shared", str(file), str(root)),
        shared=SharedTraining(file, root, resolved),
        about=(f"{resolved.method} (training)", scene),
    )


def prepare(jobs: Sequence[Job], layout: Layout) -> None:
    """Write the files that the jobs read, and let the roots of variants share the trained scenes of their seed."""
    for job in jobs:
        if job.shared is not None:
            job.shared.file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(job.shared.file, job.shared.resolved.toml())
        for cell in job.cells:
            home, link = layout.root(cell.seed) / TRAINED, cell.root / TRAINED
            if link != home and not link.is_symlink() and not link.exists():
                home.mkdir(parents=True, exist_ok=True)
                cell.root.mkdir(parents=True, exist_ok=True)
                link.symlink_to(Path("..") / home.relative_to(layout.out))
