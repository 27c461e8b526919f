"""Write the types of native operations: a `.pyi` beside every `*face.py`, from the C header that it offers.

    .venv/bin/python tools/make_faces.py

Run it after a header with a plain C face (docs/native.md) was changed; a test holds both together.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from splatwizard_native.face import OPERATION, Field, counts_of, read_structs

ROOT = Path(__file__).resolve().parents[1]
ONE = {"float": "float", "double": "float", "bool": "bool"}


def faces() -> list[Path]:
    """The Python modules that offer operations."""
    found = [*ROOT.glob("*/src/**/*face.py"), *ROOT.glob("plugins/*/src/**/*face.py")]
    return sorted(path for path in found if "__getattr__ = operations(" in path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[len(parts) - parts[::-1].index("src") :])


def kind_of(field: Field) -> str:
    """The Python type of what is handed over."""
    kind = "Tensor | Array[Any] | int" if field.pointer else ONE.get(field.kind, "int")
    if field.length is not None:
        return f"Sequence[{kind}{' | None' if field.pointer else ''}]"
    return kind


def stub(path: Path) -> str:
    """The text of the `.pyi` of a module that offers operations."""
    module = importlib.import_module(module_of(path)).MODULE
    header = module.face_header
    structs = read_structs(header)
    owned = [name for owner, name in OPERATION.findall(header) if owner == module.name]
    lines = []
    for name, fields in structs.items():
        call = name.endswith("_call")
        shown = [f for f in fields if f.out and name.removesuffix("_call") in owned] if call else fields
        if shown:
            lines += ["", f"class {name}(Structure):"]
            lines += [f"    {f.name}: {'int | None' if f.pointer else ONE.get(f.kind, 'int')}" for f in shown]
    for name in owned:
        fields = structs[f"{name}_call"]
        counts = counts_of(fields)
        lines += [*([""] if not lines or lines[-1][:1] == " " else []), f"def {name}(", "    *,"]
        for f in fields:
            may_be_left_out = f.optional or f.name in counts
            if not f.out:
                lines.append(f"    {f.name}: {kind_of(f)}{' | None = None' * may_be_left_out},")
        lines += ["    device: int | None = None,"] if module.cuda_sources else []
        lines.append(f") -> {f'{name}_call' if any(f.out for f in fields) else 'Structure'}: ...")
    body = "\n".join(lines)
    words = set(re.findall(r"\w+", body))
    head = [f'"""Types of {module.face}, written by tools/make_faces.py."""', ""]
    ctypes = [name for name in ("Array", "Structure") if name in words]
    head += ["from collections.abc import Sequence"] if "Sequence" in words else []
    head += [f"from ctypes import {', '.join(ctypes)}"]
    head += ["from typing import Any"] if "Any" in words else []
    head += ["", "from torch import Tensor"] if "Tensor" in words else []
    return "\n".join([*head, body]) + "\n"


def main() -> None:
    for path in faces():
        path.with_suffix(".pyi").write_text(stub(path), encoding="utf-8")


if __name__ == "__main__":
    main()
