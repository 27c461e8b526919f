"""CRC-32 (that of zlib and PNG) of symbols, by zlib-ng where it is installed.

The file asks for a CRC-32 of all symbols, and a table codes a symbol in 5 ns: the zlib of Python takes 0.6 to 0.9 ns
for its four bytes, zlib-ng, with the processor's carry-less multiplication, 0.08 (benchmarks/coders.py). Both give the
same number. ISA-L is as fast, but its `isal` 1.9 leaves the upper halves of the vector registers set: whatever computes
with SSE next (the CDF of a Gaussian) was 2.4 times slower.

Callers say `checksum.crc32(...)`, so that a test can replace it for all of them.
"""

from __future__ import annotations

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:  # no wheel for this system: slower, the same files
    from zlib import crc32

__all__ = ["crc32"]
