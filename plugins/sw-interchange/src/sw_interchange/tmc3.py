"""The program `tmc3` of MPEG's test model for G-PCC (tmc13), which a user names: its command line, and its streams.

Nothing of it is here. Options are those of its documentation (doc/README.options.md of MPEGGroup/mpeg-pcc-tmc13), their
values those of its test conditions for lossless geometry with an octree and lossy attributes with RAHT.
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import BitstreamError, CapabilityError, SplatwizardError

Integers = NDArray[np.int64]

VARIABLE = "SPLATWIZARD_TMC3"
GEOMETRY = 2  # type of a unit of the byte stream format, ISO/IEC 23090-9 annex B: geometry data
LOSSLESS_GEOMETRY = {
    "trisoupNodeSizeLog2": 0, "mergeDuplicatedPoints": 0, "neighbourAvailBoundaryLog2": 8,
    "intra_pred_max_node_size_log2": 6, "positionQuantizationScale": 1, "inferredDirectCodingMode": 1,
    "maxNumQtBtBeforeOt": 4, "minQtbtSizeLog2": 0, "planarEnabled": 1, "planarModeIdcmUse": 0,
}  # fmt: skip
RAHT = 0
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
MESSAGE = 200  # characters


class Unit(NamedTuple):
    """One unit of a stream: its type, and its payload."""

    kind: int
    payload: bytes


def unavailable() -> str | None:
    """Say why no `tmc3` can be run here, and what to do; None where one can."""
    named = os.environ.get(VARIABLE)
    if not named:
        return f"not available: tmc13 needs MPEG's program tmc3: build mpeg-pcc-tmc13, and name the file in {VARIABLE}"
    if os.sep in named and not os.path.isabs(named):  # files are decoded in other folders
        return f"not available: {VARIABLE}={named}: give the whole path"
    if shutil.which(named) is None:
        return f"not available: {VARIABLE}={named} is no program that can be run"
    return None


def encode(points: Integers, values: Integers | None, *, bits: int, qp: int) -> bytes:
    """The stream of points [N,3] and one value of `bits` bits for each [N]; None: of the points alone.

    Raises CapabilityError without the program, SplatwizardError where it fails.
    """
    attribute = [] if values is None else [f"--transformType={RAHT}", f"--qp={qp}", f"--bitdepth={bits}"]
    attribute += ["--disableAttributeCoding=1"] if values is None else ["--attribute=reflectance"]
    with tempfile.TemporaryDirectory(prefix="sw-tmc3-") as folder:
        cloud, stream = Path(folder) / "points.ply", Path(folder) / "points.bin"
        cloud.write_bytes(ply_of(points, values))
        geometry = [f"--{name}={value}" for name, value in LOSSLESS_GEOMETRY.items()]
        _run("--mode=0", f"--uncompressedDataPath={cloud}", f"--compressedStreamPath={stream}", *geometry, *attribute)
        return _written(stream)


def decode(stream: bytes) -> tuple[Integers, Integers | None]:
    """Points [N,3] of a stream in the program's order, and the value of each where it has them.

    Raises CapabilityError without the program, BitstreamError where it fails.
    """
    with tempfile.TemporaryDirectory(prefix="sw-tmc3-") as folder:
        cloud, file = Path(folder) / "points.ply", Path(folder) / "points.bin"
        file.write_bytes(stream)
        paths = (f"--compressedStreamPath={file}", f"--reconstructedDataPath={cloud}")
        try:
            _run("--mode=1", *paths, "--outputBinaryPly=1")
            return points_of(_written(cloud))
        except CapabilityError:
            raise
        except SplatwizardError as error:
            raise BitstreamError(str(error)) from error


def ply_of(points: Integers, values: Integers | None) -> bytes:
    """A binary .ply as the program reads it."""
    fields = [(axis, "<f4") for axis in "xyz"] + ([] if values is None else [("refc", "<u2")])
    rows = np.zeros(len(points), fields)
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    if values is not None:
        rows["refc"] = values
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {'uint16' if name == 'refc' else 'float'} {name}" for name, _ in fields]
    return "\n".join([*lines, "end_header\n"]).encode() + rows.tobytes()


def points_of(data: bytes) -> tuple[Integers, Integers | None]:
    """Points and values of a .ply that the program wrote, binary or text. Raises SplatwizardError."""
    head, found, body = data.partition(b"end_header\n")
    fields: list[tuple[str, str]] = []
    count, element = 0, ""
    lines = head.decode("ascii", errors="replace").split("\n")
    try:
        for words in (line.split() for line in lines):
            if words[:1] == ["element"]:
                element = words[1]
                count = int(words[2]) if element == "vertex" else count
            elif words[:1] == ["property"] and element == "vertex":
                fields.append((words[2], PLY_TYPES[words[1]]))
        dtype = np.dtype(fields)
        if not found or not {"x", "y", "z"} <= {name for name, _ in fields}:
            raise ValueError("it has no header of points")
        if "format ascii 1.0" in lines:
            rows = np.array([tuple(map(float, line.split())) for line in body.decode().split("\n")[:count]], dtype)
        else:
            rows = np.frombuffer(body, dtype, count=count)
    except (ValueError, LookupError, TypeError) as error:
        raise SplatwizardError(f"tmc3 wrote a .ply that cannot be read: {error}") from error
    points = np.stack([np.rint(rows[axis]) for axis in "xyz"], axis=1).astype(np.int64)
    name = next((each for each in ("refc", "reflectance") if each in dtype.names), None)  # type: ignore[operator]
    return points, None if name is None else rows[name].astype(np.int64)


def units_of(stream: bytes) -> list[Unit]:
    """The units of a stream: a byte of type, four of length (big-endian), the payload. Raises BitstreamError."""
    found, at = [], 0
    while at < len(stream):
        if at + 5 > len(stream):
            raise BitstreamError("a stream of tmc3 ends within the head of a unit")
        kind, length = struct.unpack_from(">BI", stream, at)
        if at + 5 + length > len(stream):
            raise BitstreamError("a stream of tmc3 ends within a unit")
        found.append(Unit(kind, stream[at + 5 : at + 5 + length]))
        at += 5 + length
    return found


def stream_of(units: Sequence[Unit]) -> bytes:
    """The stream of units."""
    return b"".join(struct.pack(">BI", each.kind, len(each.payload)) + each.payload for each in units)


def _written(path: Path) -> bytes:
    if not path.is_file():
        raise SplatwizardError("tmc3 ended well, but wrote no file")
    return path.read_bytes()


def _run(*words: str) -> None:
    reason = unavailable()
    if reason is not None:
        raise CapabilityError(reason, missing=["tmc3"])
    command = [os.environ[VARIABLE], *words]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    except OSError as error:
        raise CapabilityError(f"not available: {command[0]} does not start: {error}", missing=["tmc3"]) from error
    if done.returncode != 0:
        told = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines() or ["it says nothing"]
        raise SplatwizardError(f"tmc3 failed with status {done.returncode}: {told[-1][:MESSAGE]}")
