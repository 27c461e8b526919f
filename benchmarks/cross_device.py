"""Does a file decode to the same bits on the CPU and on a GPU, wherever it was written?

    python benchmarks/cross_device.py out            # every run under out that still has its checkpoint
    python benchmarks/cross_device.py out --devices cpu,cuda --jobs 4

Each run is encoded once per device, one device after the other (a run directory belongs to one process at a time), each
file decoded once per device, every time by a process of its own; the digests that `sw decode` reports cover all tensors
of the decoded model, bit by bit. Exit status 1 if two decodings of one file differ, or if anything fails. Whether the
encoders of the devices wrote the same bytes is told, too: a method may fit codebooks on the device, so that is no
requirement.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from splatwizard_core.base.files import file_sha256

LONGEST = 100  # characters of an error in the table
COLUMNS = ("run", "written on", "bytes", "encode s", "decode s", "decodings", "the devices' files")


@dataclass(frozen=True)
class Written:
    """A run's file from one device, and how it decodes on each."""

    device: str
    size: int
    sha256: str
    encode_s: float
    digests: dict[str, str]
    decode_s: dict[str, float]

    @property
    def identical(self) -> bool:
        return len(set(self.digests.values())) == 1


@dataclass(frozen=True)
class Failed:
    """Reason why there is no such file, or no model from it."""

    device: str
    why: str


class CommandError(Exception):
    """Message of `sw`, in one short line."""


def sw(*arguments: object) -> dict[str, Any]:
    """JSON that a command prints, from a fresh process. Raises CommandError."""
    command = [sys.executable, "-m", "splatwizard_core", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()
        said = next((line for line in reversed(lines) if line.startswith("error: ")), lines[-1])
        raise CommandError(short(f"{arguments[0]}: {said.removeprefix('error: ')}"))
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def short(text: str) -> str:
    """One line of at most `LONGEST` characters."""
    line = " ".join(text.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 4]} ..."


def write(run: Path, file: Path, device: str, devices: list[str]) -> Written:
    """Encode `run` on `device` as `file`; decode that on all `devices`. Raises CommandError."""
    encoded = sw("encode", run, "--out", file, "--device", device)
    decoded = {name: sw("decode", file, "--device", name, "--repeats", 1) for name in devices}
    return Written(
        device,
        file.stat().st_size,
        file_sha256(file),
        encoded["encode_s"],
        {name: d["digest"] for name, d in decoded.items()},
        {name: d["decode_s"] for name, d in decoded.items()},
    )


def compare(run: Path, scratch: Path, devices: list[str]) -> list[Written | Failed]:
    """One result for each device, one after the other: each holds the lock of the run."""
    found: list[Written | Failed] = []
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        for device in devices:
            try:
                found.append(write(run, Path(folder) / f"{device}.swz", device, devices))
            except CommandError as error:
                found.append(Failed(device, str(error)))
    return found


def add_rows(table: Table, run: Path, found: list[Written | Failed], devices: list[str]) -> int:
    """Rows of one run; how many of its files failed or decode differently."""
    name, bad = escape("/".join(run.parts[-3:])), 0
    written = [each for each in found if isinstance(each, Written)]
    agree = "" if len(written) < 2 else "the same" if len({w.sha256 for w in written}) == 1 else "differ"
    for each in found:
        if isinstance(each, Failed):
            bad += 1
            table.add_row(name, each.device, escape(each.why), *[""] * (len(COLUMNS) - 3))
            continue
        bad += not each.identical
        table.add_row(
            name, each.device, f"{each.size:,}", f"{each.encode_s:.2f}",
            ", ".join(f"{each.decode_s[d]:.2f}" for d in devices), "identical" if each.identical else "DIFFER", agree,
        )  # fmt: skip
    return bad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="a run directory, or a folder with some anywhere below")
    parser.add_argument("--devices", default="cpu,cuda", help="comma list (default: cpu,cuda)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    args = parser.parse_args()
    devices = list(dict.fromkeys(args.devices.split(",")))
    runs = sorted(path.parent for path in args.out.resolve().rglob("config.toml"))
    if not runs:
        sys.exit(f"no run directory under {args.out}")
    table = Table(title="one file, decoded on " + " and ".join(devices), title_justify="left")
    for column in COLUMNS:
        table.add_column(column, no_wrap=column in ("run", "written on"))
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as pool:
        results = pool.map(lambda run: compare(run, Path(scratch), devices), runs)
        bad = sum(add_rows(table, run, found, devices) for run, found in zip(runs, results, strict=True))
    Console(width=200).print(table)
    if bad:
        sys.exit(f"{bad} of {len(runs) * len(devices)} files failed, or decode differently")


if __name__ == "__main__":
    main()
