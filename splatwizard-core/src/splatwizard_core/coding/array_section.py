"""An array as a file section: a header that states dtype and shape, then little-endian values in C order."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

# Their codes, 1 to 12, are part of the file format: never reorder, only add.
STORED = ("<u1", "<i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8", "?")
DTYPES: dict[int, np.dtype[Any]] = dict(enumerate(map(np.dtype, STORED), start=1))
CODES = {dtype: code for code, dtype in DTYPES.items()}
MAX_NDIM = 8
MAX_ARRAY_BYTES = 1 << 33


def pack_array(array: npt.ArrayLike) -> bytes:
    """u8 dtype code, u8 number of axes, a u32 length per axis, then the values.

    Raises ValueError for a dtype without a code, more than 8 axes, or more than 8 GiB.
    """
    values = np.asarray(array)
    little = values.dtype.newbyteorder("<")
    code = CODES.get(little)
    if code is None:
        raise ValueError(f"dtype {values.dtype} cannot be stored; use one of {', '.join(str(d) for d in CODES)}")
    if values.ndim > MAX_NDIM or values.nbytes > MAX_ARRAY_BYTES or any(n >= 1 << 32 for n in values.shape):
        raise ValueError(f"an array of shape {values.shape} is too large to store")
    header = struct.pack(f"<BB{values.ndim}I", code, values.ndim, *values.shape)
    return header + values.astype(little, copy=False).tobytes()


def unpack_array(data: bytes) -> npt.NDArray[Any]:
    """The array in `data`, a writable copy in native byte order.

    Raises ValueError if header and length disagree; allocates only what `data` really holds.
    """
    if len(data) < 2:
        raise ValueError(f"{len(data)} bytes cannot hold an array header")
    code, ndim = data[0], data[1]
    dtype = DTYPES.get(code)
    if dtype is None:
        raise ValueError(f"unknown dtype code {code}")
    if ndim > MAX_NDIM:
        raise ValueError(f"{ndim} axes, at most {MAX_NDIM} are allowed")
    start = 2 + 4 * ndim
    if len(data) < start:
        raise ValueError(f"{len(data)} bytes cannot hold the header of an array with {ndim} axes")
    shape = struct.unpack_from(f"<{ndim}I", data, 2)
    expected = math.prod(shape) * dtype.itemsize
    if len(data) - start != expected:
        raise ValueError(f"{len(data) - start:,} bytes of values, shape {list(shape)} of {dtype} needs {expected:,}")
    if math.prod(n for n in shape if n) * dtype.itemsize > MAX_ARRAY_BYTES:
        raise ValueError(f"shape {list(shape)} is too large")
    if dtype.kind == "b" and data[start:].translate(None, b"\x00\x01"):
        raise ValueError("a boolean array holds bytes other than 0 and 1")
    array = np.frombuffer(data, dtype, offset=start).reshape(shape)
    return array.astype(dtype.newbyteorder("="), copy=True)
