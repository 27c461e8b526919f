"""Bits and bytes: packed integers, variable-length codes, checksums, zstd frames."""
