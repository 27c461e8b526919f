"""Operations of a plain C face: Python functions made from the header that C compiles, which check what they hand over.

The form of a header stands in <splatwizard/c_face.h>. tools/make_faces.py writes the types of these functions.
"""

from __future__ import annotations

import ctypes
import re
import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

ABI = 1
HEAD: list[tuple[str, Any]] = [
    ("size", ctypes.c_uint32), ("abi", ctypes.c_uint32), ("threads", ctypes.c_int32), ("device", ctypes.c_int32),
    ("stream", ctypes.c_void_p), ("run", ctypes.c_void_p),
]  # fmt: skip
STRUCT = re.compile(r"typedef struct \{\n(.*?)\} (\w+);", re.DOTALL)
FIELD = re.compile(r"\s*(?:const )?(\w+)(\*?) ([\w, ]+)(?:\[(\d+)\])?;\s*(?://\s*(?:\[(.*?)\])?(.*))?")
OPERATION = re.compile(r"^SW_OPERATION\((\w+), (\w+)\);", re.MULTILINE)
NUMBERS: dict[str, tuple[str, Any]] = {
    "float": ("float32", ctypes.c_float), "double": ("float64", ctypes.c_double), "bool": ("bool", ctypes.c_bool),
    "int8_t": ("int8", ctypes.c_int8), "uint8_t": ("uint8", ctypes.c_uint8), "int16_t": ("int16", ctypes.c_int16),
    "uint16_t": ("int16", ctypes.c_uint16), "int32_t": ("int32", ctypes.c_int32), "int64_t": ("int64", ctypes.c_int64),
    "uint32_t": ("int32", ctypes.c_uint32), "uint64_t": ("int64", ctypes.c_uint64),
}  # fmt: skip
"""C type -> dtype of a tensor of them (torch computes with no unsigned ones but bytes), type of one."""


class Field(NamedTuple):
    """One field of a struct.

    kind        C type of the number, or of what the pointer points to
    length      of an array of numbers or pointers; None: it is none
    shape       of a tensor: names of counts, numbers, expressions of both; None: any
    """

    name: str
    kind: str
    pointer: bool
    length: int | None
    shape: tuple[str, ...] | None
    optional: bool
    strided: bool
    out: bool


def read_structs(header: str) -> dict[str, list[Field]]:
    """Return the structs of a header, without the head of calls. Raises ValueError for a line that is no field."""
    found = {}
    for body, name in STRUCT.findall(header):
        fields: list[Field] = []
        for line in body.splitlines():
            match = FIELD.fullmatch(line)
            if match is not None and (match[2] or match[1] in NUMBERS):
                fields += _fields(*match.groups())
                if any(fields[-1].name == taken for taken, _ in HEAD):
                    raise ValueError(f"struct {name}: '{fields[-1].name}' is a field of the head")
            elif line.partition("//")[0].strip() not in ("", "sw_head head;"):
                raise ValueError(f"struct {name}: '{line.strip()}' is no field")
        found[name] = fields
    return found


def _fields(
    kind: str, star: str, names: str, length: str | None, shape: str | None, rule: str | None
) -> Iterator[Field]:
    parts = None if shape is None else tuple(part.strip() for part in shape.split(","))
    words = re.findall(r"\w+", rule or "")
    optional, strided, out = words[:2] == ["or", "null"], "strided" in words[:3], words[:1] == ["out"]
    for name in names.replace(" ", "").split(","):
        yield Field(name, kind, bool(star), int(length) if length else None, parts, optional, strided, out)


def counts_of(fields: Sequence[Field]) -> set[str]:
    """Return the names of the numbers that a call may leave out: shapes tell them."""
    told = {size for f in fields for size in f.shape or ()} | {"real_bytes"}
    return told & {f.name for f in fields if not f.pointer}


def structure(name: str, fields: list[Field], *, call: bool = False) -> Any:
    """Return the ctypes class of a struct; that of a call begins with the common head."""
    kinds: list[tuple[Any, Field]] = [(ctypes.c_void_p if f.pointer else NUMBERS[f.kind][1], f) for f in fields]
    listed = [(f.name, kind if f.length is None else kind * f.length) for kind, f in kinds]
    return type(name, (ctypes.Structure,), {"_fields_": [*(HEAD if call else ()), *listed]})


def operation(name: str, fields: list[Field], function: Any, told: Any, run: int | None, *, on_gpu: bool) -> Any:
    """Return a Python function of the fields by name, which calls `function` and returns the struct with its results.

    told    function that gives the text of the library's last error
    run     address of what runs loops on threads
    on_gpu  tensors are on one GPU, of which the keyword `device` tells where there is none; its current stream works

    A pointer takes a tensor, a ctypes array, an address, or None where the header says so. RuntimeError for what does
    not fit the header, and with the library's text if it refuses.
    """
    import torch

    def refuse(field: Field, value: torch.Tensor, counts: dict[str, Any]) -> NoReturn:
        shape = ", ".join(str(counts.get(size) or size) for size in field.shape or ())
        kind = NUMBERS.get(field.kind, (field.kind,))[0]
        raise RuntimeError(
            f"{name}: {field.name} must be a {'' if field.strided else 'contiguous '}{kind} tensor "
            f"{f'[{shape}] ' if shape else ''}on the {'GPU' if on_gpu else 'CPU'}, "
            f"got {value.dtype} {list(value.shape)} on {value.device}"
        )

    kinds = [f"{f.length or ''}{'P' if f.pointer else NUMBERS[f.kind][1]._type_}" for f in fields]
    # With an underscore, as no field begins: fields are the arguments.
    known = {
        "_torch": torch, "_Tensor": torch.Tensor, "_threads": torch.get_num_threads, "_addressof": ctypes.addressof,
        "_byref": ctypes.byref, "_fields": fields, "_refuse": refuse, "_function": function, "_told": told,
        "_made": structure(f"{name}_call", fields, call=True).from_buffer_copy,
        "_pack": struct.Struct("".join(["@", *(kind._type_ for _, kind in HEAD), *kinds, "0P"])).pack,
    }  # fmt: skip
    # As dataclasses are made: a loop over the fields took three times as long.
    exec(compile(_source(name, fields, run, on_gpu), f"<{name}>", "exec"), known)
    return known[name]


def _source(name: str, fields: list[Field], run: int | None, on_gpu: bool) -> str:
    """Return the code of an operation: counts from shapes, then a check of each tensor, then the call."""
    counts = counts_of(fields)
    free = {size for f in fields for size in f.shape or () if size.isidentifier()} - {f.name for f in fields}
    bind, check, values = [f"{size} = None" for size in sorted(free)], [], []
    unknown = counts | free
    elsewhere = "not _one.is_cuda or _one.get_device() != device" if on_gpu else "not _one.is_cpu"
    for i, field in enumerate(fields):
        x = field.name
        if not field.pointer:
            left_out = field.out or x in counts  # 0 if no tensor tells it
            filled = f"*{x}, *(0,) * ({field.length} - len({x}))"
            values.append(f"{x} or 0" if left_out else x if field.length is None else filled)
            continue
        # The arguments keep what they name alive until the call has returned; addresses have names of their own.
        one, at, indent = (x, f"_at_{x}", "") if field.length is None else ("_one", f"_at_{x}[_i]", "    ")
        tests = [elsewhere.replace("_one", one), *([] if field.strided else [f"not {one}.is_contiguous()"])]
        if field.kind in NUMBERS:
            tests.append(f"{one}.dtype is not _torch.{NUMBERS[field.kind][0]}")
        if field.kind == "sw_real":
            bind.append(f"if real_bytes is None and isinstance({x}, _Tensor): real_bytes = {x}.element_size()")
            tests.append(f"{one}.dtype is not (_torch.float64 if real_bytes == 8 else _torch.float32)")
        if field.shape is not None:
            tests.append(f"{one}.shape != ({', '.join(field.shape)},)")
            told = {size: k for k, size in enumerate(field.shape) if size in unknown}
            if told and field.length is None:
                bind.append(f"if isinstance({x}, _Tensor) and {x}.dim() == {len(field.shape)}:")
                bind += [f"    if {size} is None: {size} = {x}.shape[{k}]" for size, k in told.items()]
                unknown -= set() if field.optional else set(told)
        if field.length is not None:
            check += [f"_at_{x} = [0] * {field.length}", f"for _i, _one in enumerate({x}):"]
        check += [
            f"{indent}if isinstance({one}, _Tensor):",
            *([f"{indent}    if device is None: device = {one}.get_device()"] if on_gpu else []),
            f"{indent}    if {' or '.join(tests)}: _refuse(_fields[{i}], {one}, locals())",
            f"{indent}    {at} = {one}.data_ptr()",
        ]
        if field.length is None:
            passed = f"{x} is None or type({x}) is int" if field.optional else f"type({x}) is int"
            check.append(f"else: {at} = {x} if {passed} else _addressof({x})")
        values.append(f"_at_{x} or 0" if field.length is None else f"*_at_{x}")
    arguments = [f"{f.name}=None" if f.optional or f.out or f.name in counts else f.name for f in fields]
    # The public way to a stream makes an object of it, and takes ten times as long.
    where = "1, device, _torch._C._cuda_getCurrentRawStream(device)" if on_gpu else "_threads(), -1, 0"
    size = ctypes.sizeof(structure(name, fields, call=True))
    code = [
        # As bytes: to make a struct of its values took three times as long.
        *bind, *check, f"_call = _made(_pack({size}, {ABI}, {where}, {run or 0}, {', '.join(values)}))",
        f"if _function(_byref(_call)) != 0: raise RuntimeError(f'{name}: {{_told().decode()}}')", "return _call",
    ]  # fmt: skip
    arguments += ["device=None"] if on_gpu else []
    return "\n    ".join([f"def {name}(*, {', '.join(arguments)}):", *code])
