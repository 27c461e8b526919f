"""Writes src/sw_codecs/data/exact_tables.bin: every number that the exact mode must not compute at run time.

Needs mpmath; all values are rounded from 40 correct digits, so the file does not depend on the machine:

    python tools/make_exact_tables.py [OUTPUT]

The contents are part of the bitstream format. A change needs a new VERSION (and the old file must stay readable).
Source: specification of the codec library, "Making decode identical on every machine", rules 3 to 5.
"""

import itertools
import math
import struct
import sys
import zlib
from pathlib import Path

import mpmath

VERSION = 1
LEVELS, FRACTIONS, STEPS = 64, 8, 128
SCALE_LOW, SCALE_HIGH = mpmath.mpf(5) / 100, mpmath.mpf(64)
TOTAL = 65536
# Radius in scales: a Gaussian has 2e-9 of its mass beyond 6; a Laplacian 5e-5 beyond 10.
RADIUS = {"gaussian": 6, "laplace": 10}

mpmath.mp.dps = 40


def nearest(x: mpmath.mpf) -> int:
    """Round half up; no value here is within 1e-30 of a half."""
    return int(mpmath.floor(x + mpmath.mpf(1) / 2))


def tail(family: str, x: mpmath.mpf, scale: mpmath.mpf) -> mpmath.mpf:
    """P(X > x) for a centred variable of this scale, accurate for large x."""
    if family == "gaussian":
        return mpmath.erfc(x / (scale * mpmath.sqrt(2))) / 2
    if x >= 0:
        return mpmath.exp(-x / scale) / 2
    return 1 - mpmath.exp(x / scale) / 2


def count_table(family: str, scale: mpmath.mpf, fraction: int) -> list[int]:
    """Counts of s = -R..R and of the escape, for mean (fraction - 4) / 8."""
    mean = mpmath.mpf(fraction - 4) / 8
    radius = math.ceil(RADIUS[family] * scale) + 1
    half = mpmath.mpf(1) / 2
    edges = [tail(family, s - half - mean, scale) for s in range(-radius, radius + 2)]
    # Differences of tails lose digits on the left side, where both are near 1; 40 digits leave plenty.
    counts = [max(1, nearest(TOTAL * (a - b))) for a, b in itertools.pairwise(edges)]
    outside = 1 - edges[0] + edges[-1]
    return [*counts, max(1, nearest(TOTAL * (outside + mpmath.mpf(2) ** -16)))]


def main(output: Path) -> None:
    steps = []
    for j in range(STEPS):
        t = mpmath.mpf(-8) + (j + mpmath.mpf(1) / 2) / 8
        steps.append(max(64, nearest(4096 * (1 + mpmath.tanh(t)))))
    ratio = mpmath.log(SCALE_HIGH / SCALE_LOW) / (LEVELS - 1)
    scales = [SCALE_LOW * mpmath.exp(ratio * level) for level in range(LEVELS)]
    # 12 fractional bits, the format in which the decoder has the scale; midway on the logarithmic axis.
    thresholds = [nearest(4096 * mpmath.sqrt(a * b)) for a, b in itertools.pairwise(scales)]
    body = struct.pack(f"<{STEPS}H", *steps)
    body += struct.pack(f"<{LEVELS}I", *(nearest(scale * 2**20) for scale in scales))
    body += struct.pack(f"<{LEVELS - 1}I", *thresholds)
    for family in ("gaussian", "laplace"):
        tables = [count_table(family, scale, fraction) for scale in scales for fraction in range(FRACTIONS)]
        body += struct.pack(f"<{LEVELS}H", *(math.ceil(RADIUS[family] * scale) + 1 for scale in scales))
        for counts in tables:
            body += struct.pack(f"<{len(counts)}H", *(count - 1 for count in counts))
    data = struct.pack("<4sHI", b"SPWT", VERSION, len(body)) + body
    output.write_bytes(data + struct.pack("<I", zlib.crc32(data)))


if __name__ == "__main__":
    default = Path(__file__).parents[1] / "src" / "sw_codecs" / "data" / "exact_tables.bin"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default)
