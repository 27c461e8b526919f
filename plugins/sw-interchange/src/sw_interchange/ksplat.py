"""The .ksplat format of GaussianSplats3D, version 0.1: sections of records, positions in buckets; read only.

Source: the public description of mkkellogg/GaussianSplats3D.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import SH_C0, BitstreamError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, decoded_bytes, logit_of_byte
from sw_interchange.source import Source

HEADER, SECTION_HEADER = 4096, 1024
MAX_SECTIONS = 1 << 12

Rows = npt.NDArray[np.void]


@dataclass(frozen=True)
class _Section:
    count: int
    capacity: int
    bucket_size: int
    buckets: int
    block: float
    scale_range: int
    full: int
    partial: int
    degree: int


@dataclass(frozen=True)
class _Main:
    level: int
    count: int
    sections: int
    max_sections: int
    least_sh: float
    most_sh: float


def read_ksplat(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a file. Raises BitstreamError."""
    name, data = source.name, source.data
    main = _main_header(source)
    report.version = f"0.1, level {main.level}"
    limits.check(main.count, decoded_bytes(main.count, COEFFICIENTS[2]), len(data), name)
    sections = [_section(data, HEADER + SECTION_HEADER * i, main.level, name) for i in range(main.sections)]
    if sum(each.count for each in sections) != main.count:
        raise BitstreamError(f"{name}: its sections do not hold {main.count:,} Gaussians together")
    at, parts = HEADER + SECTION_HEADER * main.max_sections, []
    for section in sections:
        row = _row_type(main.level, section.degree)
        size = 4 * section.partial + 12 * section.buckets + row.itemsize * section.capacity
        if at + size > len(data):
            raise BitstreamError(f"{name}: a section ends at byte {at + size:,} of {len(data):,}: it is truncated")
        if section.count:
            parts.append(_decoded(data, at, section, main, row, name))
        at += size
    if not parts:
        raise BitstreamError(f"{name}: holds no Gaussian")
    degree = max(each.sh_degree for each in parts)
    k = COEFFICIENTS[degree]
    rest = [np.pad(each.sh_rest, ((0, 0), (0, k - each.sh_rest.shape[1]), (0, 0))) for each in parts]
    return GaussianScene(
        means=np.concatenate([each.means for each in parts]),
        log_scales=np.concatenate([each.log_scales for each in parts]),
        quats=np.concatenate([each.quats for each in parts]),
        opacity_logits=np.concatenate([each.opacity_logits for each in parts]),
        sh_dc=np.concatenate([each.sh_dc for each in parts]),
        sh_rest=np.concatenate(rest),
    )


def _main_header(source: Source) -> _Main:
    head = source.head(HEADER)
    if len(head) < HEADER:
        raise BitstreamError(f"{source.name}: {len(head):,} bytes are no .ksplat: it is truncated", section="header")
    major, minor, most, sections, _, count, level = struct.unpack_from("<BBxxIIIIH", head)
    least_sh, most_sh = struct.unpack_from("<ff", head, 36)
    if (major, minor) != (0, 1) or level > 2:
        raise BitstreamError(
            f"{source.name}: version {major}.{minor}, level {level} of .ksplat; 0.1 and 0 to 2 are read",
            section="header",
        )
    if not 1 <= sections <= most <= MAX_SECTIONS or HEADER + SECTION_HEADER * most > len(source.data):
        raise BitstreamError(f"{source.name}: {sections:,} of {most:,} sections make no sense", section="header")
    if not np.isfinite([least_sh, most_sh]).all():
        raise BitstreamError(f"{source.name}: the range of its SH coefficients is no number", section="header")
    return _Main(level, count, sections, most, least_sh or -1.5, most_sh or 1.5)


def _section(data: bytes | memoryview, at: int, level: int, name: str) -> _Section:
    count, capacity, bucket_size, buckets, block = struct.unpack_from("<IIIIf", data, at)
    scale_range, _, full, partial, degree = struct.unpack_from("<IIIIH", data, at + 24)
    scale_range = scale_range or (1 if level == 0 else 32767)
    if level == 0:
        buckets = full = partial = 0
    found = _Section(count, capacity, bucket_size, buckets, block, scale_range, full, partial, degree)
    sound = count <= capacity and degree <= 2 and buckets == full + partial and partial * 4 <= len(data)
    if level and count:
        sound &= buckets > 0 and bucket_size > 0 and full * bucket_size <= count and bool(np.isfinite(block))
    if not sound:
        raise BitstreamError(f"{name}: the header of a section makes no sense", section="section")
    return found


def _row_type(level: int, degree: int) -> np.dtype[np.void]:
    number = "<f4" if level == 0 else "<f2"
    sh = {0: "<f4", 1: "<f2", 2: "u1"}[level]
    fields = [("means", "<f4" if level == 0 else "<u2", 3), ("scales", number, 3), ("quats", number, 4)]
    fields += [("rgba", "u1", 4)]
    if degree:
        fields.append(("sh", sh, 3 * COEFFICIENTS[degree]))
    return np.dtype(fields)


def _decoded(
    data: bytes | memoryview, at: int, section: _Section, main: _Main, row: np.dtype[np.void], name: str
) -> GaussianScene:
    n = section.count
    lengths = np.frombuffer(data, "<u4", section.partial, at).astype(np.int64)
    at += 4 * section.partial
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, at).reshape(-1, 3)
    rows = np.frombuffer(data, row, n, at + 12 * section.buckets)
    means = rows["means"].astype(np.float32)
    if main.level:
        if section.full * section.bucket_size + int(lengths.sum()) != n:
            raise BitstreamError(f"{name}: the buckets of a section do not hold its {n:,} Gaussians", section="section")
        sizes = np.r_[np.full(section.full, section.bucket_size, np.int64), lengths]
        step = np.float32(section.block / 2 / section.scale_range)
        with np.errstate(all="ignore"):
            means = (means - np.float32(section.scale_range)) * step + np.repeat(centres, sizes, axis=0)
    scales = rows["scales"].astype(np.float32)
    with np.errstate(all="ignore"):
        log_scales = np.where(scales > 0, np.log(scales), np.where(scales == 0, np.float32(FLAT), np.float32(np.nan)))
    rgba = rows["rgba"]
    k = COEFFICIENTS[section.degree]
    return GaussianScene(
        means,
        log_scales.astype(np.float32),
        rows["quats"].astype(np.float32),
        logit_of_byte(rgba[:, 3]),
        ((rgba[:, :3].astype(np.float32) / 255 - 0.5) / SH_C0).astype(np.float32),
        _sh(rows, main, section.degree) if k else np.zeros((n, 0, 3), np.float32),
    )


def _sh(rows: Rows, main: _Main, degree: int) -> Array:
    """Band by band, each channel-major."""
    values = rows["sh"].astype(np.float32)
    if main.level == 2:
        values = np.float32(main.least_sh) + np.float32(main.most_sh - main.least_sh) / 255 * values
    bands, at = [], 0
    for band in range(1, degree + 1):
        size = 2 * band + 1
        bands.append(values[:, at : at + 3 * size].reshape(-1, 3, size).transpose(0, 2, 1))
        at += 3 * size
    return np.ascontiguousarray(np.concatenate(bands, axis=1))
