"""Write the table of the record's fields in docs/protocol.md from their declarations: `python tools/record_docs.py`."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from splatwizard_core.runs.record import Record

PAGE = Path(__file__).resolve().parents[1] / "docs" / "protocol.md"
BEGIN, END = "<!-- made by tools/record_docs.py -->\n", "<!-- end -->\n"


def rows(block: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """A row for each field, those of the blocks in it below it."""
    for name, field in block.model_fields.items():
        inner, many = inner_block(field.annotation)
        about = field.description or ("" if inner is None else inner.__doc__ or "").partition("\n")[0].rstrip(".")
        yield f"| `{prefix}{name}` | {spelled(field.annotation)} | {about} |"
        if inner is not None:
            yield from rows(inner, f"{prefix}{name}.{many}")


def inner_block(annotation: Any) -> tuple[type[BaseModel] | None, str]:
    """The block in an annotation, and what stands for the keys or places of several."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, ""
    origin, found = typing.get_origin(annotation), (None, "")
    for each in typing.get_args(annotation):
        inner, many = inner_block(each)
        found = (inner, ("*." if origin in (dict, list) else "") + many) if inner is not None else found
    return found


def spelled(annotation: Any) -> str:
    """A type as it stands in JSON."""
    if annotation is type(None):
        return "null"
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return spelled(inner[0])
    if origin is typing.Literal:
        return " or ".join(f'"{value}"' for value in inner)
    if origin is dict:
        return f"object of {spelled(inner[1])}"
    if origin is list:
        return f"list of {spelled(inner[0])}"
    if origin is tuple:
        return f"{len(inner)} {spelled(inner[0])}s"
    if inner:
        return " or ".join(spelled(each) for each in inner)
    names = {str: "text", int: "integer", float: "number", bool: "true or false", Any: "anything"}
    return names.get(annotation, "object")


def generate(page: str) -> str:
    """The page with its table made anew."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    table = "\n".join(["| field | value | what |", "|---|---|---|", *rows(Record)])
    return f"{before}{BEGIN}{table}\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(generate(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
