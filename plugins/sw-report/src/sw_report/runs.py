"""Collection of the runs of a report: found, read, told apart by name, and put in order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import FILE_NAME
from sw_report.facts import RunFacts, clean, read_facts


@dataclass(frozen=True, eq=False)
class Run:
    """One run directory.

    directory   where its record lies
    facts       what the record says
    variant     the method as this report names it: told apart by preset or folder where the name is not enough
    root        the argument under which it was found
    """

    directory: Path
    facts: RunFacts
    variant: str
    root: Path

    @property
    def label(self) -> str:
        """Method and rate point."""
        return f"{self.variant} {self.facts.rate}" if self.facts.rate else self.variant

    @property
    def place(self) -> tuple[str, str]:
        """Scene and protocol id: results of one place may be compared."""
        return self.facts.scene, self.facts.protocol.id

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views, if it is known."""
        found = self.facts.metrics.get(metric)
        return None if found is None else found.mean


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
        raise UserInputError(f"no {FILE_NAME} under {where}: `sw run --out {paths[0]}` makes them")
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
    runs, told_apart = _tell_apart(runs)
    return Collection(sorted(runs, key=_order), notes + told_apart + _protocol_notes(runs))


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
    return natural(facts.scene), facts.protocol.id, natural(run.variant), facts.file.bytes, facts.rate or ""


def _tell_apart(runs: list[Run]) -> tuple[list[Run], list[str]]:
    """Name what one name would mix: presets of a method, then folders; of what still is equal, the newest stays."""
    for distinguish in (_by_preset, _by_root):
        clashing = {
            runs[i].facts.method
            for group in _clashes(runs)
            if len({distinguish(runs[j]) for j in group}) > 1
            for i in group
        }
        runs = [replace(run, variant=distinguish(run)) if run.facts.method in clashing else run for run in runs]
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


def _clashes(runs: list[Run]) -> list[list[int]]:
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.place, run.variant, run.facts.rate), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def _by_preset(run: Run) -> str:
    return f"{run.variant} ({run.facts.preset})" if run.facts.preset else run.variant


def _by_root(run: Run) -> str:
    return f"{run.variant} [{clean(run.root.resolve().name)}]"


def _protocol_notes(runs: list[Run]) -> list[str]:
    """Say where one scene was measured under several protocols, and speed on several machines."""
    notes = []
    by_scene: dict[tuple[str, str], list[str]] = {}
    machines: dict[str, None] = {}
    for run in runs:
        by_scene.setdefault((run.facts.dataset, run.facts.scene), []).append(run.facts.protocol.id)
        machines.setdefault(machine(run.facts))
    for (_, scene), ids in by_scene.items():
        different = list(dict.fromkeys(ids))
        if len(different) > 1:
            notes.append(
                f"scene {scene} was measured under {len(different)} protocols, which are not comparable and stand "
                f"apart: {'; '.join(different)}"
            )
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
        parts.append(f"{threads} thread" + "s" * (threads != 1))
    return clean(", ".join(parts))
