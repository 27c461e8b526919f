"""Collection of the runs of a report: found, read, told apart by name, and put in order."""

from __future__ import annotations

import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import FILE_NAME, several
from sw_report.configurations import PRESET, configurations, described, differing, seed_of
from sw_report.declared import method_title, rate_position
from sw_report.facts import RunFacts, clean, read_facts
from sw_report.sweeps import is_sweep, sweep_notes


@dataclass(frozen=True, eq=False)
class Run:
    """One run directory, or several that differ in the seed alone.

    directory   where its record lies
    facts       what the record says; of several seeds, the smallest one's
    variant     the method as this report names it: told apart by preset, by what differs in its configuration or by
                folder where the name is not enough
    root        the argument under which it was found
    repeats     the runs of all seeds, each alone, this one first; empty: one run
    """

    directory: Path
    facts: RunFacts
    variant: str
    root: Path
    repeats: tuple[Run, ...] = ()

    @property
    def label(self) -> str:
        """Method and rate point."""
        return f"{self.variant} {self.facts.rate}" if self.facts.rate else self.variant

    @property
    def title(self) -> str:
        """The variant with its method's name as papers write it."""
        method = self.facts.method
        rest = self.variant.removeprefix(method)
        return self.variant if rest == self.variant else method_title(method) + rest

    @property
    def place(self) -> tuple[str, str]:
        """Scene and protocol id: results of one place may be compared."""
        return self.facts.scene, self.facts.protocol.id

    @property
    def seeds(self) -> tuple[RunFacts, ...]:
        """Records of every seed."""
        return tuple(run.facts for run in self.repeats) or (self.facts,)

    @property
    def size(self) -> float:
        """Bytes of the file, mean over the seeds."""
        return statistics.fmean(facts.file.bytes for facts in self.seeds)

    @property
    def counts(self) -> dict[str, float]:
        """Primitives by unit, mean over the seeds."""
        units = [unit for unit in self.facts.counts if all(unit in facts.counts for facts in self.seeds)]
        return {unit: statistics.fmean(facts.counts[unit] for facts in self.seeds) for unit in units}

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views and the seeds, if it is known."""
        return self.over_seeds(lambda facts: facts.mean(metric))[0]

    def deviation(self, metric: str) -> float | None:
        """Standard deviation of a metric's mean over the seeds (of the sample, n - 1); None for one seed."""
        return self.over_seeds(lambda facts: facts.mean(metric))[1]

    def over_seeds(self, value: Callable[[RunFacts], float | None]) -> tuple[float | None, float | None]:
        """Mean and standard deviation (n - 1) of a value over the seeds; None where one is unknown, or it is one."""
        values = [value(facts) for facts in self.seeds]
        known = [each for each in values if each is not None]
        if len(known) < len(values):
            return None, None
        return statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None

    def contended(self, phase: str) -> bool:
        """Whether other processes wanted the cores in this phase, with any seed."""
        return any(phase in facts.contended for facts in self.seeds)


@dataclass(frozen=True)
class Collection:
    """Runs that were found.

    runs        by scene, protocol, method and size
    notes       one line each: what could not be read, and what a reader must know before comparing
    """

    runs: list[Run]
    notes: list[str]


def collect(paths: Sequence[Path]) -> Collection:
    """Read every run under these folders. Raises UserInputError if there is none that can be read."""
    found: dict[Path, tuple[Path, Path]] = {}
    for root in paths:
        if not root.exists():
            raise UserInputError(f"{root}: there is no such folder")
        for record in record_paths(root):
            found.setdefault(record.resolve(), (record, root))
    if not found:
        where = ", ".join(map(str, paths))
        sweeps = [root for root in paths if is_sweep(root)]
        how = f"`sw bench` goes on with the sweep in {sweeps[0]}" if sweeps else f"`sw run --out {paths[0]}` makes them"
        raise UserInputError(f"no {FILE_NAME} under {where}: {how}")
    runs: list[Run] = []
    remarked: dict[str, list[str]] = {}
    problems: list[UserInputError] = []
    for record, root in found.values():
        try:
            facts, remarks = read_facts(record)
        except UserInputError as error:
            problems.append(error)
            continue
        runs.append(Run(record.parent, facts, facts.method, root))
        for remark in remarks:
            remarked.setdefault(remark, []).append(clean(str(record.parent)))
    if not runs:
        raise problems[0]
    notes = [
        f"{folders[0]}{f' and {len(folders) - 1} more' if len(folders) > 1 else ''}: {remark}"
        for remark, folders in remarked.items()
    ]
    notes += [f"left out: {clean(str(problem))}" for problem in problems]
    runs, by_configuration = _tell_configurations_apart(runs)
    runs, told_apart = _tell_apart(runs)
    notes += by_configuration + told_apart + _protocol_notes(runs)
    for root in dict.fromkeys(paths):
        notes += sweep_notes(root, [record for record, under in found.values() if under == root])
    joined = sorted(_seeds_joined(runs), key=_order)
    if len(joined) < len(runs):
        notes.append(OF_SEEDS)
    return Collection(joined, notes)


def record_paths(root: Path) -> list[Path]:
    """Paths of all records at or below a path; a run directory holds one, and nothing below it is looked at."""
    if root.is_file():
        return [root]
    own = root / FILE_NAME
    return [own] if own.is_file() else sorted(path for path in root.rglob(FILE_NAME) if path.is_file())


def natural(text: str) -> tuple[tuple[int, int | str], ...]:
    """Sorting key: scan9 before scan10."""
    return tuple((0, int(part)) if part.isdigit() else (1, part.lower()) for part in re.split(r"(\d{1,18})", text))


def _order(run: Run) -> tuple[object, ...]:
    facts = run.facts
    rate = facts.rate or ""
    at = rate_position(facts.method, rate)
    return natural(facts.scene), facts.protocol.id, natural(run.variant), at, natural(rate), run.size


OF_SEEDS = (
    "runs that differ in the seed alone are one row, mean ± standard deviation; pictures, sections, training and "
    "scores view by view are of the smallest seed"
)
MOST_KEYS = 3  # in the name of a configuration
MOST_TOLD = 8  # in a note about them


def _tell_configurations_apart(runs: list[Run]) -> tuple[list[Run], list[str]]:
    """Give every configuration of a method a name of its own, and say what differs: no two may share a curve or mean.

    By the preset where that is enough, else by what differs if it is little, else by a number.
    """
    by_method: dict[str, list[int]] = {}
    for i, run in enumerate(runs):
        by_method.setdefault(run.facts.method, []).append(i)
    named, notes = list(runs), []
    for method, group in by_method.items():
        found = configurations([runs[i].facts for i in group])
        distinct = list({tuple(sorted(each.items())): each for each in found}.values())
        if len(distinct) < 2:
            continue
        keys = [key for key in differing(distinct) if key != PRESET]
        presets = [runs[i].facts.preset for i in group]
        if len({each.get(PRESET) for each in distinct}) == len(distinct):
            names = [preset or "no preset" for preset in presets]
        elif len(keys) <= MOST_KEYS:
            mixed = len(set(presets)) > 1
            names = [", ".join(filter(None, (preset if mixed else "", described(each, keys))))
                     for preset, each in zip(presets, found, strict=True)]  # fmt: skip
        else:
            names = [f"configuration {distinct.index(each) + 1}" for each in found]
        for i, name in zip(group, names, strict=True):
            named[i] = replace(runs[i], variant=f"{method} ({name})")
        if keys:
            told = ", ".join(keys[:MOST_TOLD]) + (f" and {len(keys) - MOST_TOLD} more" if len(keys) > MOST_TOLD else "")
            notes.append(clean(f"runs of {method} differ in more than the rate, and stand apart: {told}"))
    return named, notes


def _tell_apart(runs: list[Run]) -> tuple[list[Run], list[str]]:
    """Name apart by their folders what one name would mix; of what still is equal, the newest stays."""
    clashing = {
        runs[i].variant for group in _clashes(runs) if len({_by_root(runs[j]) for j in group}) > 1 for i in group
    }
    runs = [replace(run, variant=_by_root(run)) if run.variant in clashing else run for run in runs]
    dropped: set[int] = set()
    notes = []
    for group in _clashes(runs):
        newest = max(group, key=lambda i: (runs[i].facts.date or "", str(runs[i].directory)))
        dropped |= set(group) - {newest}
        first = runs[newest]
        notes.append(
            f"{len(group)} runs of {first.label} on {first.facts.scene} have the same name; "
            f"the newest is shown ({clean(str(first.directory))})"
        )
    return [run for i, run in enumerate(runs) if i not in dropped], notes


def _seeds_joined(runs: list[Run]) -> list[Run]:
    """One run for all seeds of a configuration at a rate point; what is not a number is the smallest seed's."""
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.place, run.variant, run.facts.rate), []).append(run)
    joined = []
    for group in groups.values():
        group.sort(key=lambda run: -1 if (seed := seed_of(run.facts)) is None else seed)
        joined.append(replace(group[0], repeats=tuple(group)) if len(group) > 1 else group[0])
    return joined


def _clashes(runs: list[Run]) -> list[list[int]]:
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.place, run.variant, run.facts.rate, seed_of(run.facts)), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def _by_root(run: Run) -> str:
    return f"{run.variant} [{clean(run.root.resolve().name)}]"


def _protocol_notes(runs: list[Run]) -> list[str]:
    """Say where one scene was measured under several protocols, speed on several machines, a method in releases."""
    notes = []
    releases: dict[str, dict[str, None]] = {}
    by_scene: dict[tuple[str, str], list[str]] = {}
    machines: dict[str, None] = {}
    for run in runs:
        by_scene.setdefault((run.facts.dataset, run.facts.scene), []).append(run.facts.protocol.id)
        machines.setdefault(machine(run.facts))
        if run.facts.distribution:
            releases.setdefault(run.variant, {})[run.facts.distribution] = None
    for (_, scene), ids in by_scene.items():
        different = list(dict.fromkeys(ids))
        if len(different) > 1:
            notes.append(
                f"scene {scene} was measured under {len(different)} protocols, which are not comparable and stand "
                f"apart: {'; '.join(different)}"
            )
    for variant, names in releases.items():
        if len(names) > 1:
            notes.append(f"runs of {variant} were made by different releases: {', '.join(names)}")
    if len(machines) > 1:
        notes.append(f"times, FPS and memory come from different machines: {'; '.join(machines)}")
    return notes


def machine(facts: RunFacts) -> str:
    """Device, processor and threads, as far as the record says."""
    environment = facts.environment
    gpu = environment.get("gpu")
    name = gpu.get("name") if isinstance(gpu, dict) else environment.get("cpu")
    threads = environment.get("threads")
    parts = [str(environment.get("device", "unknown device")), str(name or "unknown processor")]
    if not isinstance(gpu, dict) and isinstance(threads, int):
        parts.append(several(threads, "thread"))
    return clean(", ".join(parts))
