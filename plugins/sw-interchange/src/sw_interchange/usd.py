"""Reading OpenUSD: the prims ParticleField3DGaussianSplat of a .usda, .usdc or .usdz, each moved by those above it.

Source: the schema of OpenUSD 26.03 (UsdVol). The files are read by usd-core, an optional dependency, in a process of
its own with bounds on memory and time.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatwizard_core.api import BitstreamError, CapabilityError, UserInputError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.frames import placed
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, decoded_bytes, joined, logits_of
from sw_interchange.source import Source

FRAMES = {"Y": "RUB", "Z": "RFU"}
"""Axes of a stage by its upAxis."""
PROGRAM = Path(__file__).with_name("usd_process.py")
MEGABYTES, SECONDS = (192, 24), (0.3, 0.06)
"""Memory and processor time of usd-core, once loaded, for a file: of the smallest, and of each megabyte more. Text
takes a quarter of this time."""
WATCH, IDLE = 0.05, 0.25
"""Seconds between looks at usd-core, and how long it may sleep: it waits for nothing but its own threads."""
MAX_LINE = 1 << 20


def check_usd_core() -> None:
    """Raise CapabilityError if usd-core is not installed."""
    if importlib.util.find_spec("pxr") is None or importlib.util.find_spec("pxr.UsdVol") is None:
        raise CapabilityError("OpenUSD needs usd-core: pip install usd-core", missing=["usd-core"])


def read_usd(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode all splats of a file. Raises BitstreamError, CapabilityError without usd-core."""
    check_usd_core()
    told, data = _by_usd_core(source)
    report.warnings += [str(each) for each in told["notes"]]
    if told["up"] not in FRAMES:
        raise BitstreamError(f"{source.name}: its upAxis is '{told['up']}'")
    parts, at = [], 0
    for prim in told["prims"]:
        n, k = prim["count"], COEFFICIENTS[prim["degree"]]
        limits.check(n, decoded_bytes(n, k), len(source.data), source.name)
        part, at = _scene(data, at, n, k), at + decoded_bytes(n, k)
        try:
            part = placed(part, np.array(prim["place"]))
        except UserInputError as error:
            raise BitstreamError(
                f"{source.name}: {prim['name']} is moved in a way that is not read: {error}"
            ) from error
        if not prim["has_sh"]:
            report.warnings.append(f"{prim['name']} has no colours, or too few for its degree: it is grey")
        parts.append(replace(part, antialiased=prim["antialiased"], kind="2dgs" if prim["surfels"] else "default"))
    if not parts and told["notes"]:
        first = told["notes"][0].partition(" ")[0]
        raise BitstreamError(
            f"{source.name}: none of its splats is drawn: {first} is invisible, or a guide or proxy: change its "
            "visibility or purpose"
        )
    if not parts:
        raise BitstreamError(f"{source.name}: there are no splats in it: no prim is a ParticleField3DGaussianSplat")
    if len({(each.antialiased, each.kind) for each in parts}) > 1:
        report.warnings.append("its prims are to be drawn in different ways; all are drawn like the first")
    return replace(joined(parts), frame=FRAMES[told["up"]], meta={"meters_per_unit": told["meters"]})


def _by_usd_core(source: Source) -> tuple[dict[str, Any], memoryview]:
    """Ask the process: the line that it tells of a file, and the numbers after it. Raises BitstreamError."""
    megabytes, seconds = (least + more * len(source.data) / 2**20 for least, more in (MEGABYTES, SECONDS))
    with tempfile.TemporaryDirectory() as folder:
        # A name of its own in an empty folder: a relative path in the file leads nowhere.
        path = Path(folder) / ("scene.usdz" if source.head(2) == b"PK" else "scene.usd")
        if source.path is not None:
            path.symlink_to(source.path.resolve())
        else:
            path.write_bytes(source.data)
        command = [sys.executable, str(PROGRAM), str(path), str(megabytes), str(seconds)]
        answer = Path(folder) / "answer"
        failed = _run(command, answer)
        found = b"" if failed else answer.read_bytes()
    line, _, _ = found[:MAX_LINE].partition(b"\n")
    if failed or not line:
        raise BitstreamError(f"{source.name}: usd-core breaks off on it: it is damaged, or takes too much")
    told: dict[str, Any] = json.loads(line)
    if "refused" in told:
        raise BitstreamError(f"{source.name}: {told['refused']}")
    return told, memoryview(found)[len(line) + 1 :]


def _run(command: list[str], answer: Path) -> int:
    """Run a program whose output goes into a file, until it ends or does nothing any more; its exit status."""
    environment = {**os.environ, "PXR_WORK_THREAD_LIMIT": "1"}
    with answer.open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL, env=environment)
    used, slept = -1, 0.0
    try:
        while True:
            try:
                return process.wait(WATCH)
            except subprocess.TimeoutExpired:
                now = _asleep(process.pid)
                used, slept = now, slept + WATCH if 0 <= now == used else 0.0
                if slept >= IDLE:
                    process.kill()
    finally:
        process.kill()
        process.wait()


def _asleep(pid: int) -> int:
    """Processor time, in ticks, of a process all of whose threads sleep; -1 of another, and where Linux is not."""
    try:
        # Behind the name: the state, and as numbers 11 and 12 the time in the program and in the system.
        threads = [path.read_text().rpartition(")")[2].split() for path in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:
        return -1
    if not threads or any(state != "S" for state, *_ in threads):
        return -1
    return sum(int(told[11]) + int(told[12]) for told in threads)


def _scene(data: memoryview, at: int, n: int, k: int) -> GaussianScene:
    def column(width: int) -> Array:
        nonlocal at
        found = np.frombuffer(data, np.float32, n * width, at).reshape(n, width).copy()
        at += found.nbytes
        return found

    means, quats, scales, alphas, sh = (column(width) for width in (3, 4, 3, 1, 3 * (k + 1)))
    rest = sh.reshape(n, k + 1, 3)
    return GaussianScene(
        means, np.where(scales == 0, np.float32(FLAT), np.log(scales)).astype(np.float32), quats[:, [3, 0, 1, 2]],
        logits_of(alphas[:, 0]), rest[:, 0], np.ascontiguousarray(rest[:, 1:]), frame="RUB",
    )  # fmt: skip
