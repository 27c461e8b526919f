"""`sw bench --dry-run`: the processes that a plan would start, and about how long they take."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

from splatwizard_core.tooling import duration, print_json, print_table, say, several
from sw_bench.cells import Cell, Job, Layout
from sw_bench.display import SLOTS_UNKNOWN
from sw_bench.estimates import Estimates
from sw_bench.executor import Executor
from sw_bench.index import FILE_NAME, Index
from sw_bench.state import State


def dry_run(
    jobs: Sequence[Job],
    cells: Sequence[Cell],
    states: Mapping[Cell, State],
    layout: Layout,
    executor: Executor | None,
    *,
    probe: bool,
    as_json: bool,
) -> None:
    """Print what would run. Nothing is written but into temporary folders."""
    estimates = Estimates()
    if (layout.out / FILE_NAME).is_file():
        index = Index(layout.out)
        estimates = Estimates(index.durations())
        index.close()
    if probe:
        from sw_bench.probe import probe_into

        probe_into(estimates, jobs)
    slots = SLOTS_UNKNOWN if executor is None else executor.slots or SLOTS_UNKNOWN
    left = estimates.left(jobs, [], slots)
    counts = {state.value: sum(each is state for each in states.values()) for state in State}
    facts = [
        {
            "name": job.name, "command": shlex.join(["sw", *job.words]), "needs": [need.name for need in job.needs],
            "runs": [{"directory": str(cell.directory), "state": states[cell].value} for cell in job.cells],
            "seconds": estimates.of(job),
        }
        for job in jobs
    ]  # fmt: skip
    if as_json:
        print_json({"out": str(layout.out), "runs": counts, "processes": facts, "at_a_time": slots, "seconds": left})
        return
    rows = []
    for job in jobs:
        told = sorted({states[cell].value for cell in job.cells}) or ["new"]
        seconds = estimates.of(job)
        rows.append([job.name, ", ".join(told), "?" if seconds is None else duration(seconds)])
    print_table(["process", "state", "about"], rows, right=1)
    counted = ", ".join(f"{number} {name}" for name, number in counts.items() if number)
    processes = f"{len(jobs)} process{'es' * (len(jobs) != 1)}, {slots} at a time"
    say(f"{len(cells)} runs of {plan_size(cells)}: {counted}; {processes}, "
        + ("of unknown length" if left is None else f"about {duration(left)} of training"))  # fmt: skip


def plan_size(cells: Sequence[Cell]) -> str:
    """`8 methods x 3 scenes x 2 seeds`."""
    sizes = {
        "method": len({cell.label for cell in cells}), "scene": len({cell.scene for cell in cells}),
        "seed": len({cell.seed for cell in cells}),
    }  # fmt: skip
    return " x ".join(several(n, name) for name, n in sizes.items())
