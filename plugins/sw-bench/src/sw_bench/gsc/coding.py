"""Encoding and decoding, each in a process of its own: its seconds, its peak memory, and nothing it should not know."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatwizard_core.api import SplatwizardError
from splatwizard_core.tooling import DATA_VARIABLE

HIDDEN = (DATA_VARIABLE, "SPLATWIZARD_TEST_DATA")
"""Environment of data sets, which a decoder must not see."""
REASON = 300  # characters
LOOK = 0.01  # s between looks at the size of a process


class CodecFailedError(SplatwizardError):
    """A codec's process failed; the message is its own."""


@dataclass(frozen=True)
class Coded:
    """One encoded model.

    bytes       of the whole file
    sections    bytes by section, header included; they sum to `bytes`
    encode_s, decode_s      wall clock inside the processes, without imports
    rss_encode_mb, rss_decode_mb    peak resident set of the processes, 10^6 bytes; None where the system tells none
    splats      of the decoded model
    digest      SHA-256 of the decoded model, of the decoding process
    """

    bytes: int
    sections: dict[str, int]
    encode_s: float
    decode_s: float
    rss_encode_mb: float | None
    rss_decode_mb: float | None
    splats: int
    digest: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def code(source: Path, target: Path, method: str, rate: str | None, sets: list[str], device: str) -> Coded:
    """Encode a model's file into `target`, and decode that in an empty folder. Raises CodecFailedError."""
    target.parent.mkdir(parents=True, exist_ok=True)
    words = ["encode", str(source.resolve()), "--method", method, "--out", str(target.resolve()), "--device", device]
    words += ["--rate", rate] if rate is not None else []
    encoded, rss_encode = run([*words, *(word for each in sets for word in ("--set", each))], Path.cwd())
    with tempfile.TemporaryDirectory(prefix="sw-gsc-") as folder:
        shutil.copyfile(target, Path(folder) / target.name)
        decoded, rss_decode = run(["decode", target.name, "--repeats", "1", "--device", device], Path(folder))
    return Coded(
        bytes=target.stat().st_size,
        sections={str(name): int(size) for name, size in decoded["sections"].items()},
        encode_s=float(encoded["encode_s"]),
        decode_s=float(decoded["decode_s"]),
        rss_encode_mb=rss_encode,
        rss_decode_mb=rss_decode,
        splats=int(decoded["counts"].get("num_gaussians", 0)),
        digest=str(decoded["digest"]),
    )


def run(words: list[str], folder: Path) -> tuple[dict[str, Any], float | None]:
    """Run `sw WORDS --json` in a folder: the facts it prints, and its peak resident set in 10^6 bytes.

    Raises CodecFailedError with its last line, KeyboardInterrupt where it was interrupted.
    """
    environment = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    command = [sys.executable, "-m", "splatwizard_core", *words, "--json"]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=err
        )
        try:
            peak = _peak_of(process)
        except BaseException:
            process.kill()
            process.wait()
            raise
        out.seek(0)
        err.seek(0)
        said, told = out.read().decode(errors="replace"), err.read().decode(errors="replace").strip()
    if process.returncode == 130:
        raise KeyboardInterrupt
    if process.returncode != 0:
        last = told.splitlines()[-1].removeprefix("error: ") if told else f"status {process.returncode}"
        raise CodecFailedError(f"sw {words[0]}: {last[:REASON]}")
    found: dict[str, Any] = json.loads(said)
    return found, peak


def _peak_of(process: subprocess.Popen[bytes]) -> float | None:
    """Wait for a process; its peak resident set, 10^6 bytes, where the system tells it (Linux).

    Looks at it while it runs: what the kernel says of a process that has ended counts its parent's size before `exec`.
    """
    status, peak = Path(f"/proc/{process.pid}/status"), 0
    while process.poll() is None:
        with contextlib.suppress(OSError):
            found = re.search(r"^VmHWM:\s*(\d+)", status.read_text(), re.MULTILINE)
            peak = max(peak, int(found[1]) if found is not None else 0)
        time.sleep(LOOK)
    return peak * 1024 / 1e6 if peak else None
