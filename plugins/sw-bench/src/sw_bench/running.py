"""One command of a sweep: from the plan to the table at its end."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from pydantic import ValidationError

from splatwizard_core.api import ConfigError, UserInputError
from splatwizard_core.tooling import (
    OUTPUT_FOLDER,
    Choices,
    PluginManager,
    choose_device,
    directory_lock,
    load_plugins,
    print_json,
    print_table,
    say,
)
from sw_bench.cells import Cell, Job, Layout, cells_of, differing_bases, jobs_of, prepare, training_key
from sw_bench.display import Lines, LiveTable
from sw_bench.estimates import Estimates
from sw_bench.executor import Executor, Site
from sw_bench.index import Index
from sw_bench.plan import Plan, checked_plan, read_plan
from sw_bench.results import results, table_of
from sw_bench.state import State, changes_of, discard, discard_shared, left_to_do, state_of
from sw_bench.sweep import Sweep

NAMED = 5  # runs that a message names
LOCAL = "local"  # the executor of this machine
OF_A_PLAN = ("rate", "preset", "images", "init", "config_file", "sets")


@dataclass(frozen=True)
class Wanted:
    """The plan of a command.

    plan    of the whole sweep
    layout  places of its runs
    text    of the file; empty: the options of the command
    part    the methods, scenes and seeds of it that are to run; None: all
    """

    plan: Plan
    layout: Layout
    text: str
    part: Plan | None = None

    def has(self, cell: Cell) -> bool:
        """Whether a run of the plan is to run."""
        part = self.part or self.plan
        return cell.label in part.methods and cell.scene in part.scenes and cell.seed in part.seeds


def plan_of_options(path: str | None, given: Mapping[str, Any]) -> Wanted:
    """Read the plan of a command, or make it of its options. Raises ConfigError, UserInputError or click.UsageError."""
    if given.get("allow_changed_plan"):
        raise click.UsageError("--allow-changed-plan is for one run at a time: leave out further scenes and seeds")
    methods, scenes, seeds = words_of(given["methods"]), scenes_of(given["scene"]), seeds_of(given["seed"])
    if path is None and not (methods or scenes or seeds or given["config_file"]):
        raise click.UsageError("name a PLAN.toml, or what to run by --method, --scene and --seed")
    part = None
    if path is None:
        plan, text = _plan_of_words(methods, scenes, seeds, given), ""
    else:
        useless = next((name for name in OF_A_PLAN if given[name]), None)
        if useless is not None:
            option = {"config_file": "config", "sets": "set"}.get(useless, useless)
            raise click.UsageError(f"--{option} stands in the plan, {path}: put it there, or leave the plan out")
        plan, text = read_plan(path)
        part = plan.part(methods, scenes, seeds)
    changes = {
        "device": given["device"] or plan.device, "executor": given["executor"] or plan.executor,
        "geometry": given["geometry"] or plan.geometry, "options": _with_pairs(plan.options, _pairs(given["given"])),
        "repeats": given["repeats"] if given["repeats"] != 1 else plan.repeats,
    }  # fmt: skip
    plan = plan.model_copy(update=changes)
    out = given["out"] or plan.out or ("out" if path is None else f"out/{Path(path).stem}")
    OUTPUT_FOLDER.convert(out, None, None)
    return Wanted(plan, Layout(Path(out).resolve(), path is not None or len(plan.seeds) > 1), text, part)


def _plan_of_words(methods: list[str], scenes: list[str], seeds: list[int], given: Mapping[str, Any]) -> Plan:
    plugins, file = load_plugins(), given["config_file"]
    default = {"methods": plugins.methods.default, "scenes": plugins.datasets.default}
    if file is not None:
        said = Choices(methods=tuple(methods), config_file=file)
        default["methods"] = said.method_names(plugins)[0]
        default["scenes"] = default["scenes"] if scenes else said.resolve(plugins)[0].scene_spec
    if not scenes:
        started = Choices(init=given["init"], config_file=file, sets=tuple(given["sets"])).of_start()
        default["scenes"] = started.scene or default["scenes"]
    content: dict[str, Any] = {
        "methods": methods or [name for name in [default["methods"]] if name],
        "scenes": scenes or [name for name in [default["scenes"]] if name],
        "seeds": seeds or [0], "rates": given["rate"], "preset": given["preset"],
        "images": given["images"], "init": given["init"], "config": file, "set": _pairs(given["sets"]),
    }  # fmt: skip
    return checked_plan(content, "the command")


def words_of(given: Sequence[str]) -> list[str]:
    """Split comma lists."""
    return list(dict.fromkeys(word.strip() for text in given for word in text.split(",") if word.strip()))


def scenes_of(given: str | None) -> list[str]:
    """Split a comma list of scenes; a path that is there may have commas in its name."""
    return [] if given is None else [given] if Path(given).exists() else words_of([given])


def seeds_of(given: int | tuple[int, ...] | None) -> list[int]:
    """Return the seeds that an option gave."""
    return [] if given is None else [given] if isinstance(given, int) else list(dict.fromkeys(given))


def _pairs(words: Sequence[str]) -> dict[str, Any]:
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"KEY=VALUE is needed, not '{word}'")
        found[key.strip()] = value.strip()
    return found


def _with_pairs(options: Mapping[str, Any], pairs: Mapping[str, str]) -> dict[str, Any]:
    """Put `KEY=VALUE`, or `TABLE.KEY=VALUE`, into options of an executor."""
    found = {key: dict(value) if isinstance(value, Mapping) else value for key, value in options.items()}
    for key, value in pairs.items():
        table, _, inner = key.partition(".")
        if not inner:
            found[key] = value
        elif isinstance(found.setdefault(table, {}), dict):
            found[table][inner] = value
        else:
            raise ConfigError(f"option '{table}' is no table: '{key}' cannot be set", key=key)
    return found


def bench_plan(wanted: Wanted, given: Mapping[str, Any]) -> int:
    """Run a plan, or print what it would run; return the exit status: 1 if a run failed."""
    plugins, plan, layout = load_plugins(), wanted.plan, wanted.layout
    planned = cells_of(plan, layout, plugins)
    cells = [cell for cell in planned if wanted.has(cell)]
    if not cells:
        raise ConfigError("this part of the plan leaves no run: every one is skipped")
    states = {cell: state_of(cell, plugins, geometry=plan.geometry) for cell in cells}
    changed = [cell for cell in cells if states[cell] is State.CHANGED]
    again = bool(given["rerun_changed"]) or not given.get("resume", True)
    if changed and not again and not given["dry_run"]:
        raise UserInputError(_about_changed(changed, cells, states, layout, plugins))
    if not given.get("resume", True):
        states = dict.fromkeys(cells, State.CHANGED)
    elif given["recheck"]:
        states |= {cell: State.BEGUN for cell in cells if states[cell] is State.FINISHED}
    unfinished = [cell for cell in cells if states[cell] is not State.FINISHED]
    jobs = jobs_of(unfinished, layout, plugins)
    for line in differing_bases(cells, plugins):
        say(f"note: {line}")
    own = set[str]() if given.get("resume", True) else {cell.training for cell in cells}
    if given["dry_run"]:
        from sw_bench.dry_run import dry_run

        jobs = left_to_do(jobs, own)
        executor = None if plan.executor != LOCAL else make_executor(plan, layout, plugins)
        dry_run(jobs, cells, states, layout, executor, probe=given["probe"], as_json=given["as_json"])
        return 0
    executor = make_executor(plan, layout, plugins)
    layout.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        stack.enter_context(directory_lock(layout.out, say=say))
        index = Index(layout.out)
        stack.callback(index.close)
        _begin(index, wanted, planned, states)
        for cell in unfinished:
            if states[cell] is State.CHANGED:
                discard(cell)
        for job in jobs:
            if job.shared is not None and training_key(job.shared.resolved) in own:
                discard_shared(job.shared)
        jobs = left_to_do(jobs)
        prepare(jobs, layout)
        estimates = Estimates(index.durations())
        finished = [cell for cell in cells if states[cell] is State.FINISHED]
        say(_counts(cells, states, jobs, executor))
        try:
            with _display(cells, finished, estimates) as display:
                sweep = Sweep(layout.out, jobs, executor, index, display, retries=given["retries"])
                sweep.run()
        finally:
            rows = results(cells, index)
        failed = bool(sweep.failed)
        if given["as_json"]:
            print_json({"out": str(layout.out), "runs": rows})
        else:
            print_table(*table_of(rows, plugins))
            say(f"`sw report {_shown(layout.out)}` makes tables, curves and a page of these runs")
    return int(failed)


def make_executor(plan: Plan, layout: Layout, plugins: PluginManager) -> Executor:
    """Make the executor of a plan. Raises PluginError for one that is not there, ConfigError for wrong options."""
    cls = plugins.executors.load(plan.executor)
    try:
        chosen = cls.Options.model_validate(plan.options)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            known = list(cls.Options.model_fields)
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known) or 'none'}"
            raise ConfigError(f"executor '{plan.executor}' has no option '{key}': {hint}", key=key) from None
        reason = first["msg"].removeprefix("Input should be ")
        raise ConfigError(f"bad value {first['input']!r} for option '{key}' of '{plan.executor}': {reason}") from None
    asked = plan.device or "auto"  # other machines may have what this one lacks
    device = choose_device(asked, plugins).type if plan.executor == LOCAL else asked
    made: Executor = cls(chosen, Site(layout.out, device))
    return made


def _begin(index: Index, wanted: Wanted, planned: Sequence[Cell], states: Mapping[Cell, State]) -> None:
    """Bring the index to the whole plan and the states of what is to run, and say what it no longer has."""
    gone = index.plan(planned)
    if gone:
        named = ", ".join(gone[:NAMED]) + (", ..." if len(gone) > NAMED else "")
        say(f"{len(gone)} runs of before are not in the plan any more, and stay where they are: {named}")
    with index.together():
        index.put("plan", wanted.text or wanted.plan.model_dump_json())
        for cell, state in states.items():
            finished = state is State.FINISHED
            row = index.row(cell)
            if finished and row.status != "finished":
                index.note(cell, status="finished", reason="")
            elif not finished and row.status != "waiting":
                index.note(cell, status="waiting", reason="")


def _display(cells: list[Cell], finished: list[Cell], estimates: Estimates) -> Lines:
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        return LiveTable(cells, finished, estimates, console)
    return Lines(cells, finished, estimates)


def _counts(cells: Sequence[Cell], states: Mapping[Cell, State], jobs: Sequence[Job], executor: Executor) -> str:
    count = {state: sum(each is state for each in states.values()) for state in State}
    parts = [f"{number} {state.value}" for state, number in count.items() if number]
    places = "" if executor.slots is None else f", {executor.slots} at a time"
    return f"{len(cells)} runs: {', '.join(parts)}; {len(jobs)} process{'es' * (len(jobs) != 1)} to go{places}"


def _about_changed(
    changed: Sequence[Cell], cells: Sequence[Cell], states: Mapping[Cell, State], layout: Layout, plugins: PluginManager
) -> str:
    """Message about runs whose directories hold another training."""
    named = f"{changed[0].name}: {changes_of(changed[0], plugins)}" + ("; ..." if len(changed) > 1 else "")
    kept = sum(state in (State.FINISHED, State.BEGUN) for state in states.values())
    return (
        f"{_shown(layout.out)}: {len(changed)} of {len(cells)} runs were trained with other values ({named}), {kept} "
        "fit the plan: --rerun-changed discards those and trains them anew, another --out keeps them"
    )


def _shown(path: Path) -> Path:
    """Path as short as it can be told."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
