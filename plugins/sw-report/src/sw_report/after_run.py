"""Reports that `sw run` leaves: a page in each run directory, with the photographs that it shows, and the table.

Several runs also have a page above their directories, and beside it rate and distortion as a file of its own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from splatwizard_core.api import Scene
from splatwizard_core.tooling import FILE_NAME as RECORD
from splatwizard_core.tooling import FinishedRuns, ForeseenError, write_atomic
from sw_report.collapse import collapse_warning
from sw_report.facts import read_facts
from sw_report.page import FILE_NAME, write_page
from sw_report.rd_file import FILE_NAME as PLOT_NAME
from sw_report.rd_file import rd_svg
from sw_report.results import print_results
from sw_report.runs import collect
from sw_report.truth import keep_truth


def report_finished(runs: FinishedRuns) -> None:
    """Write the page of each run as it finishes, and tell of collapses; at the end the table, and what is about all."""
    directories = [run.directory for run in runs.runs]
    if not runs.complete:
        pages = [report_run(run.directory, run.open_scene, runs.say) for run in runs.runs]
        runs.written.extend(page for page in pages if page is not None)
        for line in filter(None, (collapse_warning(run.record) for run in runs.runs)):
            runs.say(line)
        return
    above = [report_above(directories, runs.say), plot_above(directories, runs.say)]
    if any(above):  # the pages of single runs lie beside their records
        own = {directory / FILE_NAME for directory in directories}
        runs.written[:] = [path for path in runs.written if path not in own]
    runs.written.extend(path for path in above if path is not None)
    if runs.console is not None:
        print_results([(run.record, run.directory) for run in runs.runs], runs.written, runs.console)


def report_run(directory: Path, open_scene: Callable[[], Scene], say: Callable[[str], None]) -> Path | None:
    """Write the page of a finished run, unless it is there and newer than its record, and return its path.

    A page that cannot be made is told in one line (and None): it never makes a finished run fail.
    """
    page = directory / FILE_NAME
    with _told(page, say) as made:
        if not _is_newer(page, [directory]):
            facts, _ = read_facts(directory / RECORD)
            keep_truth(directory, facts, open_scene())
            write_page(collect([directory]), page)
        made.append(page)
    return page if made else None


def report_above(directories: Sequence[Path], say: Callable[[str], None]) -> Path | None:
    """Write the page about several runs into the folder right above all that one command made; None for a single run.

    Whatever else lies in that folder is in it too: earlier rate points and methods of the same scene.
    """
    if len(directories) < 2:
        return None
    folder = folder_above(directories)
    page = folder / FILE_NAME
    with _told(page, say) as made:
        if not _is_newer(page, [path.parent for path in folder.rglob(RECORD)]):
            write_page(collect([folder]), page)
        made.append(page)
    return page if made else None


def plot_above(directories: Sequence[Path], say: Callable[[str], None]) -> Path | None:
    """Write rate and distortion as a file of its own beside that page; None for a single run.

    It shows the runs of the same scene under the same protocol that lie in the folder.
    """
    if len(directories) < 2:
        return None
    folder = folder_above(directories)
    plot = folder / PLOT_NAME
    with _told(plot, say) as made:
        place = collect(directories[:1]).runs[0].place
        runs = [run for run in collect([folder]).runs if run.place == place]
        if not _is_newer(plot, [run.directory for run in runs]):
            variants = {run.variant for run in runs}
            whose = f" of {variants.pop()}" if len(variants) == 1 else ""  # one line has no legend
            drawn = rd_svg(runs, f"Rate and distortion{whose} on {place[0]}")
            if drawn is None:
                return None  # no metric has a value: the table says why
            write_atomic(plot, drawn)
        made.append(plot)
    return plot if made else None


def folder_above(directories: Sequence[Path]) -> Path:
    """Folder right above all these run directories."""
    parents = {directory.parent for directory in directories}
    return parents.pop() if len(parents) == 1 else directories[0].parent.parent


@contextlib.contextmanager
def _told(page: Path, say: Callable[[str], None]) -> Iterator[list[Path]]:
    """Turn any error into one line: the run is finished, and its table follows."""
    try:
        yield []
    except Exception as error:
        foreseen = isinstance(error, (ForeseenError, OSError, ValueError))
        why = str(error) if foreseen else f"{type(error).__name__}: {error}"
        say(f"warning: {page} was not written: {why} (the results are whole; `sw report` makes pages, too)")


def _is_newer(page: Path, directories: Sequence[Path]) -> bool:
    """Whether a page was written after the records that it is about."""
    try:
        written = page.stat().st_mtime_ns
        return all((directory / RECORD).stat().st_mtime_ns <= written for directory in directories)
    except OSError:
        return False
