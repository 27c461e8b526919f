"""A stand-in for `tmc3`: its command line, its .ply and its units, with coding of its own. It compresses nothing.

Values lose what a step of 2^((QP - 4) / 6) loses. Points come out in the order of their coordinates, as the program's
need not be those of its input. Arguments that it does not know are an error, as is `FAKE_TMC3=fail`.
"""

import os
import struct
import sys
import zlib

import numpy as np

KNOWN = {
    "mode", "uncompressedDataPath", "compressedStreamPath", "reconstructedDataPath", "outputBinaryPly", "transformType",
    "qp", "bitdepth", "attribute", "disableAttributeCoding", "trisoupNodeSizeLog2", "mergeDuplicatedPoints",
    "neighbourAvailBoundaryLog2", "intra_pred_max_node_size_log2", "positionQuantizationScale",
    "inferredDirectCodingMode", "maxNumQtBtBeforeOt", "minQtbtSizeLog2", "planarEnabled", "planarModeIdcmUse",
}  # fmt: skip
SEQUENCE, GEOMETRY, VALUES = 0, 2, 4


def unit(kind: int, payload: bytes) -> bytes:
    return struct.pack(">BI", kind, len(payload)) + payload


def encode(options: dict[str, str]) -> None:
    with open(options["uncompressedDataPath"], "rb") as file:
        head, _, body = file.read().partition(b"end_header\n")
    has_values = b"property uint16 refc" in head
    assert has_values == (options.get("attribute") == "reflectance")
    rows = np.frombuffer(body, [(axis, "<f4") for axis in "xyz"] + [("refc", "<u2")] * has_values)
    order = np.lexsort((rows["x"], rows["y"], rows["z"]))
    points = np.stack([rows[axis][order] for axis in "xyz"], axis=1).astype("<i4")
    stream = unit(SEQUENCE, b"a sequence") + unit(GEOMETRY, zlib.compress(points.tobytes()))
    if has_values:
        step = 2 ** ((int(options["qp"]) - 4) / 6)
        coded = np.rint(rows["refc"][order] / step).astype("<i4")
        stream += unit(VALUES, struct.pack("<d", step) + zlib.compress(coded.tobytes()))
    with open(options["compressedStreamPath"], "wb") as file:
        file.write(stream)


def decode(options: dict[str, str]) -> None:
    with open(options["compressedStreamPath"], "rb") as file:
        stream = file.read()
    units, at = {}, 0
    while at < len(stream):
        kind, length = struct.unpack_from(">BI", stream, at)
        units[kind] = stream[at + 5 : at + 5 + length]
        at += 5 + length
    points = np.frombuffer(zlib.decompress(units[GEOMETRY]), "<i4").reshape(-1, 3)
    rows = np.zeros(len(points), [(axis, "<f8") for axis in "xyz"] + [("refc", "<u2")] * (VALUES in units))
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float64 {axis}" for axis in "xyz"]
    if VALUES in units:
        (step,) = struct.unpack_from("<d", units[VALUES])
        coded = np.frombuffer(zlib.decompress(units[VALUES][8:]), "<i4")
        rows["refc"] = np.clip(np.rint(coded * step), 0, 65535)
        lines.append("property uint16 refc")
    lines += ["element face 0", "property list uint8 int32 vertex_index", "end_header"]
    with open(options["reconstructedDataPath"], "wb") as file:
        file.write("".join(f"{line}\n" for line in lines).encode() + rows.tobytes())


def main(words: list[str]) -> None:
    given = dict(word.removeprefix("--").split("=", 1) for word in words)
    if unknown := set(given) - KNOWN:
        sys.exit(f"unknown option {sorted(unknown)[0]}")
    if os.environ.get("FAKE_TMC3") == "fail":
        sys.exit("Error: could not open input file!")
    decode(given) if given["mode"] == "1" else encode(given)


if __name__ == "__main__":
    main(sys.argv[1:])
