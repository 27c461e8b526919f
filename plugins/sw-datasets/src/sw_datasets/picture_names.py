"""Finds the file of each picture that a scene names: other suffixes, Unicode forms, Windows and absolute paths."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import NoReturn

from splatwizard_core.api import SceneError

SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))

MOST_PARTS = 64
"""Folders at the end of a path of another machine that are looked for here, one by one."""
LONGEST_TOLD = 120
"""Characters of a name in a message."""


def is_inside(name: str) -> bool:
    """Whether a relative file name from a stranger's file stays inside the folder it is joined to."""
    path = PurePosixPath(name.replace("\\", "/"))
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


def list_pictures(folder: Path) -> list[str]:
    """Names of all pictures below `folder`, relative to it with forward slashes, sorted.

    Links are followed, but no folder is entered twice: links in a ring would never end.
    Raises SceneError for a folder that cannot be read.
    """

    def unreadable(error: OSError) -> NoReturn:
        raise SceneError(f"{error.filename} cannot be read: {error.strerror}", path=str(folder)) from error

    found = []
    entered: set[str] = set()
    for root, folders, files in os.walk(folder, onerror=unreadable, followlinks=True):
        real = os.path.realpath(root)
        if real in entered:
            folders.clear()
            continue
        entered.add(real)
        folders.sort()
        for file in files:
            # "._NAME" is what macOS writes beside NAME onto disks of others, and no picture.
            if os.path.splitext(file)[1].lower() in SUFFIXES and not file.startswith("._"):
                found.append((Path(root) / file).relative_to(folder).as_posix())
    return sorted(found)


def find_pictures(folder: Path, names: Sequence[str], notes: list[str] | None = None) -> list[Path]:
    """The file of each name.

    That is `folder/name`; else the one file whose name is the same text in another Unicode form, the same stem with
    another picture suffix, or the same but for upper and lower case. Of names that lead out of the folder, or are
    written with backslashes, the last parts are looked for inside it.

    notes   gets a line on what was taken for names that are not those of the files

    Raises SceneError that lists the first five missing, for names that lead out of the folder, and where it is not
    clear which file is meant: two files of one stem, or one file for two names.
    """
    there = _Files(folder)
    found: list[Path] = []
    missing: list[str] = []
    of: dict[str, str | None] = {}
    for name in names:
        if name not in of:
            of[name] = there.of(name)
        file = of[name]
        if file is not None:
            found.append(folder / file)
        elif is_inside(name) or _is_foreign(name):
            missing.append(name)
        else:
            raise SceneError(
                f"image name {short(name)} leads out of {folder}; the scene files are damaged", path=str(folder)
            )
    if missing:
        first = ", ".join(map(short, missing[:5])) + (", ..." if len(missing) > 5 else "")
        raise SceneError(f"{folder}: {len(missing)} of {len(names)} images are missing: {first}", path=str(folder))
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise SceneError(
            f"{folder}: image name {short(repeated[0])} occurs more than once ({len(repeated)} of this kind)",
            path=str(folder),
        )
    served: dict[Path, str] = {}
    for name, path in zip(names, found, strict=True):
        if served.setdefault(path, name) != name:
            raise SceneError(
                f"{folder}: {path.name} is the only file for two images, '{served[path]}' and '{name}'",
                path=str(folder),
            )
    if notes is not None:
        notes += there.notes()
    return found


def find_each(folder: Path, names: Sequence[str]) -> list[Path | None]:
    """The file of each name, as `find_pictures` has it; None where there is none, or it is not clear which."""
    there, found = _Files(folder), list[Path | None]()
    for name in names:
        try:
            file = there.of(name)
        except SceneError:
            file = None
        found.append(None if file is None else folder / file)
    return found


def short(name: str) -> str:
    """A stranger's name as it stands in a message: printable, and no longer than a line."""
    return repr(name) if len(name) <= LONGEST_TOLD else f"{name[:LONGEST_TOLD]!r}..."


def view_name(name: str, file: Path, folder: Path) -> str:
    """The name of a view: the text of the scene's file, or where that is no plain relative path, that of the file."""
    plain = is_inside(name) and "\\" not in name and not _is_foreign(name)
    return name if plain else file.relative_to(folder).as_posix()


def name_key(name: str) -> str:
    """The text by which names are compared that differ in Unicode form alone."""
    return unicodedata.normalize("NFC", name.replace("\\", "/").removeprefix("./"))


def _is_foreign(name: str) -> bool:
    """Whether a name is an absolute path of some machine, such as `C:\\scans\\a.png`."""
    return "\0" not in name and (bool(re.match(r"[A-Za-z]:[\\/]|\\\\", name)) or name.startswith("/"))


def _stem(name: str) -> str:
    return os.path.splitext(name)[0]


WAYS: tuple[tuple[str, Callable[[str], str]], ...] = (
    ("", name_key),
    ("", lambda name: name_key(_stem(name))),
    ("differ from those of the files in upper and lower case", lambda name: name_key(name).casefold()),
    ("differ from those of the files in upper and lower case", lambda name: name_key(_stem(name)).casefold()),
)
"""Warning about names found this way -> form by which names are compared, the nearest form first."""


class _Files:
    """The picture files below a folder, by what their names are compared by."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.told: dict[str, int] = {}

    @cached_property
    def _all(self) -> list[str]:
        return list_pictures(self.folder)

    @cached_property
    def _by_key(self) -> list[dict[str, list[str]]]:
        tables: list[dict[str, list[str]]] = [{} for _ in WAYS]
        for name in self._all:
            for (_, key), table in zip(WAYS, tables, strict=True):
                table.setdefault(key(name), []).append(name)
        return tables

    def of(self, name: str) -> str | None:
        """The file of a name, relative to the folder; None if there is none. Raises SceneError where two could be."""
        if is_inside(name) and os.path.isfile(self.folder / name):  # False, not an error, for a name that is too long
            return name
        parts = [part for part in re.split(r"[\\/]", name) if part not in ("", ".")]
        if is_inside(name) and not _is_foreign(name):
            return self._like("/".join(parts), name)
        # A path of another machine: its end is looked for here, the longest first.
        for start in range(max(len(parts) - MOST_PARTS, 0), len(parts)):
            end = parts[start:]
            if ".." in end or ":" in end[0] or "\0" in name:
                continue
            if (found := self._like("/".join(end), name)) is not None:
                self._tell("are paths of another place: their last parts were looked for in this folder")
                return found
        return None

    def _like(self, name: str, called: str) -> str | None:
        for (told, key), table in zip(WAYS, self._by_key, strict=True):
            candidates = table.get(key(name), [])
            if len(candidates) > 1:
                raise SceneError(
                    f"{self.folder}: image '{called}' is not there, and {' and '.join(candidates[:3])} could both "
                    "stand for it; keep one",
                    path=str(self.folder),
                )
            if candidates:
                if told:
                    self._tell(told)
                return candidates[0]
        return None

    def _tell(self, what: str) -> None:
        self.told[what] = self.told.get(what, 0) + 1

    def notes(self) -> list[str]:
        """A line for each kind of name that is not that of its file."""
        return [f"{count} picture names {what}" for what, count in self.told.items()]
