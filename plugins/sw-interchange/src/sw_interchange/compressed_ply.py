"""The compressed .ply of PlayCanvas: chunks of 256 Gaussians with bounds of their own, 16 bytes each and 8-bit SH.

Source: the public description in playcanvas/splat-transform.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sw_gaussians.ply_tables import MAX_HEADER, Table, read_header, read_tables

from splatwizard_core.api import SH_C0, BitstreamError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.options import Options
from sw_interchange.order import morton_order
from sw_interchange.quats import ROOT_2, from_smallest_three, smallest_three
from sw_interchange.scene import GaussianScene, Limits, ReadReport, WriteReport, decoded_bytes, logits_of, sigmoid
from sw_interchange.source import Source

CHUNK = 256
_AXES, _COLOURS = ("x", "y", "z"), ("r", "g", "b")
BOUNDS = [
    *(f"{end}_{axis}" for end in ("min", "max") for axis in _AXES),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in _AXES),
    *(f"{end}_{colour}" for end in ("min", "max") for colour in _COLOURS),
]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
WIDTHS = (11, 10, 11)
"""Bits of x, y and z, of which x is highest."""
LARGEST_SCALE = 20.0
COARSE_COLOUR = 0.05  # of full brightness: a larger error is seen

Words = npt.NDArray[np.uint32]


def read_compressed_ply(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a file. Raises BitstreamError."""
    name = source.name
    header = read_header(source.head(MAX_HEADER), len(source.data), name)
    count = header.count("vertex")
    missing = [each for each in PACKED if each not in header.names("vertex")]
    missing += [each for each in BOUNDS[:12] if each not in header.names("chunk")]
    if missing:
        raise BitstreamError(f"{name}: not a compressed .ply: '{missing[0]}' is missing", section="header")
    if header.count("chunk") != -(-count // CHUNK):
        raise BitstreamError(
            f"{name}: {header.count('chunk'):,} chunks do not fit {count:,} Gaussians", section="chunk"
        )
    # Degree 0 has no element `sh`; some writers write one without properties.
    coefficients = [each for each in header.names("sh") if each.startswith("f_rest_")]
    degrees = {3 * k: degree for degree, k in COEFFICIENTS.items() if degree < 4}
    wanted = [f"f_rest_{i}" for i in range(len(coefficients))]
    if (
        len(coefficients) not in degrees
        or sorted(coefficients) != sorted(wanted)
        or (coefficients and header.count("sh") != count)
    ):
        raise BitstreamError(f"{name}: {len(coefficients)} SH values of {header.count('sh'):,} Gaussians", section="sh")
    k = len(coefficients) // 3
    limits.check(count, decoded_bytes(count, k), len(source.data), name)
    tables = read_tables(source.data, header, ("chunk", "vertex", *(["sh"] if k else [])), name)
    bounds = _bounds(tables["chunk"])
    chunk = np.arange(count) >> 8
    if any(tables["vertex"].dtype[each].str[1:] != "u4" for each in PACKED):
        raise BitstreamError(
            f"{name}: the packed properties of a compressed .ply are unsigned integers", section="vertex"
        )
    words = [np.asarray(tables["vertex"][each]).astype(np.uint32) for each in PACKED]
    colour, alpha = _four_bytes(words[3])
    colours = _within(colour / np.float32(255), bounds[4][chunk], bounds[5][chunk])
    report.ignored += [each for each in header.names("vertex") if each not in PACKED]
    return GaussianScene(
        means=_within(_three(words[0]), bounds[0][chunk], bounds[1][chunk]),
        log_scales=_within(_three(words[2]), bounds[2][chunk], bounds[3][chunk]),
        quats=_rotations(words[1]),
        opacity_logits=_logits(alpha),
        sh_dc=((colours - np.float32(0.5)) / np.float32(SH_C0)).astype(np.float32),
        sh_rest=_sh(tables["sh"], k) if k else np.zeros((count, 0, 3), np.float32),
        antialiased=any(comment.lower().replace(" ", "") == "antialiased1" for comment in header.comments),
        meta={"comments": header.comments},
    )


def _bounds(chunks: Table) -> list[Array]:
    """Six arrays [chunks,3]: least and greatest coordinate, log scale, colour (0..1 in older files)."""
    names = chunks.dtype.names or ()
    told = [np.asarray(chunks[each]).astype(np.float32) if each in names else None for each in BOUNDS]
    found = []
    for i in range(0, len(BOUNDS), 3):
        default = np.full(len(chunks), (i // 3) % 2, np.float32)
        found.append(np.stack([default if each is None else each for each in told[i : i + 3]], axis=1))
    return found


def _within(share: Array, low: Array, high: Array) -> Array:
    return low * (1 - share) + high * share


def _three(words: Words) -> Array:
    """[N,3] in 0..1 of 11, 10 and 11 bits."""
    fields = np.stack([words >> 21, (words >> 11) & 1023, words & 2047], axis=1)
    return fields.astype(np.float32) / np.array([2047, 1023, 2047], np.float32)


def _four_bytes(words: Words) -> tuple[Array, Words]:
    colour = np.stack([words >> 24, (words >> 16) & 255, (words >> 8) & 255], axis=1).astype(np.float32)
    return colour, words & 255


def _logits(codes: Words) -> Array:
    return logits_of(codes.astype(np.float32) / 255)


def _rotations(words: Words) -> Array:
    fields = np.stack([words >> 20, words >> 10, words], axis=1) & 1023
    return from_smallest_three(words >> 30, (fields.astype(np.float32) / 1023 - np.float32(0.5)) * ROOT_2)


def _sh(table: Table, k: int) -> Array:
    """[N,K,3]: the middles of 256 bins over -4..4, the ends of the outermost."""
    codes = 8 * ((np.arange(256) + 0.5) / 256 - 0.5)
    codes[0], codes[-1] = -4, 4
    channels = np.stack([np.asarray(table[f"f_rest_{i}"]) for i in range(3 * k)], axis=1)
    if channels.dtype != np.uint8:
        raise BitstreamError("the SH values of a compressed .ply are bytes, these are not", section="sh")
    return np.ascontiguousarray(codes.astype(np.float32)[channels].reshape(-1, 3, k).transpose(0, 2, 1))


def write_compressed_ply(scene: GaussianScene, options: Options, report: WriteReport) -> list[bytes]:
    """Encode a scene in RDF, in Morton order: chunks that lie together have narrow bounds."""
    scene = scene.select(morton_order(scene.means))
    n, k = scene.num_gaussians, scene.sh_rest.shape[1]
    starts = np.arange(0, n, CHUNK)
    chunk = np.arange(n) >> 8
    report.count("log_scales", np.abs(scene.log_scales) > LARGEST_SCALE)
    values = [scene.means, np.clip(scene.log_scales, -LARGEST_SCALE, LARGEST_SCALE)]
    values.append((0.5 + np.float32(SH_C0) * scene.sh_dc).astype(np.float32))
    bounds, shares = [], []
    for kind, each in zip(("means", "log_scales", "colours"), values, strict=True):
        low, high = np.minimum.reduceat(each, starts), np.maximum.reduceat(each, starts)
        span = high - low
        wide = np.where(span < 1e-5, np.float32(np.inf), span)
        bounds += [low, high]
        _tell_loss(kind, span, chunk, scene, report)
        shares.append(np.clip((each - low[chunk]) / wide[chunk], 0, 1))
    alphas = sigmoid(scene.opacity_logits)
    vertex = np.stack(
        [_packed_three(shares[0]), _packed_rotations(scene.quats), _packed_three(shares[1]),
         _packed_bytes(shares[2], alphas)], axis=1).astype("<u4")  # fmt: skip
    comments = "comment antialiased 1\n" if scene.antialiased else ""
    header = f"ply\nformat binary_little_endian 1.0\n{comments}element chunk {len(starts)}\n"
    header += "".join(f"property float {each}\n" for each in BOUNDS) + f"element vertex {n}\n"
    header += "".join(f"property uint {each}\n" for each in PACKED)
    parts = [np.concatenate(bounds, axis=1).astype("<f4").tobytes(), vertex.tobytes()]
    if k:
        header += f"element sh {n}\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(3 * k))
        report.count("sh_rest", np.abs(scene.sh_rest) > 4)
        codes = np.clip(np.trunc(256 * (scene.sh_rest / 8 + np.float32(0.5))), 0, 255).astype(np.uint8)
        parts.append(codes.transpose(0, 2, 1).tobytes())
    return [(header + "end_header\n").encode("ascii"), *parts]


def _tell_loss(kind: str, span: Array, chunk: npt.NDArray[np.int64], scene: GaussianScene, report: WriteReport) -> None:
    """Warn where one outlier of a chunk of 256 makes the steps of all others coarse.

    span    [chunks,3] greatest minus least value
    """
    if kind == "log_scales":
        return  # within 20 of 0 they lose a fiftieth at the most
    if kind == "means":
        levels = np.array([(1 << bits) - 1 for bits in WIDTHS], np.float64)
        report.coarse((span / levels)[chunk], scene.means, scene.log_scales)
        return
    steps = span / 255
    coarse = (steps.max(axis=1) / 2 > COARSE_COLOUR)[chunk]
    if coarse.any():
        report.warnings.append(
            f"colours of {int(coarse.sum()):,} of {len(chunk):,} Gaussians lose up to "
            f"{steps.max() / 2:.2g}: outliers widen the range of their chunks of {CHUNK}"
        )


def _unorm(share: Array, bits: int) -> Words:
    most = np.float32((1 << bits) - 1)
    return np.clip(np.floor(share * most + np.float32(0.5)), 0, most).astype(np.uint32)


def _packed_three(share: Array) -> Words:
    x, y, z = (_unorm(share[:, i], bits) for i, bits in enumerate(WIDTHS))
    return (x << np.uint32(21)) | (y << np.uint32(11)) | z


def _packed_rotations(quats: Array) -> Words:
    largest, others = smallest_three(quats)
    a, b, c = (_unorm(others[:, i] / ROOT_2 + np.float32(0.5), 10) for i in range(3))
    return (largest.astype(np.uint32) << np.uint32(30)) | (a << np.uint32(20)) | (b << np.uint32(10)) | c


def _packed_bytes(colours: Array, alphas: Array) -> Words:
    r, g, b = (_unorm(colours[:, i], 8) for i in range(3))
    return (r << np.uint32(24)) | (g << np.uint32(16)) | (b << np.uint32(8)) | _unorm(alphas, 8)
