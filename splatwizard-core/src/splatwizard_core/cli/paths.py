"""Paths that commands take, checked before the work and not after it. All raise UserInputError."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from splatwizard_core.errors import UserInputError, no_file


def existing(path: str | Path, hint: str = "") -> Path:
    """A file or folder that must be there; `hint` ends the message of the error."""
    found = Path(path)
    if not found.exists():
        raise UserInputError(f"{path}: there is no such file or folder{hint}")
    if not found.is_file() and not found.is_dir():
        raise UserInputError(f"{path}: {no_file(found)}")
    return found


def existing_file(path: str | Path) -> Path:
    """A file that must be there; of a run directory the error names the file inside."""
    found = existing(path)
    if found.is_dir():
        inside = [found / name for name in ("scene.swz", "lod-meta.json") if (found / name).is_file()]
        hint = f"the file in it is {inside[0]}" if inside else "name the .swz or .ply in it"
        raise UserInputError(f"{path} is a folder, and this command takes a file: {hint}")
    return found


def output_file(path: str | Path) -> Path:
    """A path that a file can be written to; of a link, what it leads to."""
    target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if target.is_dir():
        raise UserInputError(f"{path} is a folder: give the name of a file in it")
    if target.exists() and not target.is_file():
        raise UserInputError(f"cannot write {path}: it is a pipe or a device, whose place a file would take")
    if not target.parent.is_dir():
        raise UserInputError(f"cannot write {path}: there is no folder {target.parent}")
    _check_writable(target.parent, f"cannot write {path}")
    return target


def output_page(path: str | Path) -> Path:
    """An output file with the name of a page, by which a browser knows it."""
    target = output_file(path)
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise UserInputError(f"cannot write {path}: this is a page, give a name that ends in .html")
    return target


def output_folder(path: str | Path) -> Path:
    """A folder that files can be written to, there or not; whoever writes the first file makes it."""
    target = Path(path)
    nearest = next(place for place in (target, *target.absolute().parents) if place.exists())
    if nearest == target and not target.is_dir():
        raise UserInputError(f"cannot write into {path}: it is a file, not a folder")
    _check_writable(nearest, f"cannot write into {path}")
    return target


def _check_writable(folder: Path, told: str) -> None:
    """Find out by writing whether a file can be written into a folder that is there."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UserInputError(f"{told}: {folder}: {error.strerror}") from None


class CheckedPath(click.ParamType):  # type: ignore[type-arg]  # generic only in new releases of click
    """A parameter that is a path: checked while the command line is read, completed by the shell."""

    name = "path"

    def __init__(self, check: Callable[[str | Path], Path], completed: str = "file") -> None:
        self.check, self.completed = check, completed

    def convert(self, value: str | Path, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        return self.check(value)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type=self.completed)]


EXISTING, INPUT_FILE, OUTPUT_FILE = CheckedPath(existing), CheckedPath(existing_file), CheckedPath(output_file)
OUTPUT_PAGE, OUTPUT_FOLDER = CheckedPath(output_page), CheckedPath(output_folder, "dir")
