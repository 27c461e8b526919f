"""Reader of published.toml: the figures that were published of a method, as its package brings them.

A method's entry in the registry declares `published="package:published.toml"`. Figures of methods that nobody has
installed stand in `published_others.toml` of this package, conditions that many share in `protocols.toml`.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from splatwizard_core.api import SplatwizardError, UserInputError
from splatwizard_core.tooling import Entry, load_plugins

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

log = logging.getLogger(__name__)

OTHERS, PROTOCOLS = "published_others.toml", "protocols.toml"
LARGEST_FILE = 4_000_000  # bytes; all figures known to us take 60,000
DECLARED = re.compile(r"([\w.]+):([\w.-]+\.toml)")


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PublishedProtocol(Strict):
    """Conditions of a published figure.

    text        in words
    rules       rule of a record's protocol -> the published value, or those that it may have
    unstated    what the source does not say
    size        width and height of the pictures, pixels
    comparable  False: figures of this protocol stand in no table beside others
    """

    text: str
    rules: dict[str, str | int | list[str]] = {}
    unstated: list[str] = []
    size: tuple[int, int] | None = None
    test_views: int | None = None
    comparable: bool = True


class Figure(Strict):
    """One published row.

    rate        the rate point of ours that is meant; None: there is none
    variant     name of the rate at its source
    scene       None: the mean over the data set
    psnr, ..., gaussians    as published, PSNR in dB, primitives as submitted; None: not published
    steps       of the whole training, all stages; None: not known
    differs     what differs from a measurement of ours whatever is done
    source      where it was read; {scene} in it stands for the scene
    verified    False: second-hand, or recalled and not re-read
    preset, sets, images    how a run here comes closest; without a preset it is not run
    """

    method: str = Field(min_length=1)
    variant: str = ""
    rate: str | None = None
    dataset: str
    scene: str | None = None
    psnr: float | None = Field(None, gt=0, lt=100)
    ssim: float | None = Field(None, gt=0, le=1)
    lpips: float | None = Field(None, ge=0)
    bytes: int | None = Field(None, gt=0)
    gaussians: int | None = Field(None, gt=0)
    steps: int | None = Field(None, gt=0)
    protocol: PublishedProtocol
    differs: list[str] = []
    source: str = Field(min_length=1)
    year: int
    verified: bool
    preset: str | None = None
    sets: list[str] = []
    images: str = ""

    @property
    def label(self) -> str:
        """Method, and the name of the rate at its source."""
        return f"{self.method}, {self.variant}" if self.variant else self.method


@cache
def read_published() -> tuple[Figure, ...]:
    """Collect the figures of every installed method, then those of methods that are not installed.

    A file that cannot be read is left out, with one line that names its distribution.
    """
    found: list[Figure] = []
    entries = [entry for entry in load_plugins().methods if entry.declared.get("published")]
    for entry in entries:
        try:
            found += published_by(entry)
        except (Exception, SystemExit) as error:  # a stranger's package, imported to find the file
            told = " ".join((str(error) if isinstance(error, SplatwizardError) else repr(error)).split())
            log.warning("%s %s: published figures of '%s' are left out: %s",
                        entry.distribution, entry.version, entry.name, told)  # fmt: skip
    own = {entry.name for entry in entries}
    found += (figure for figure in read_figures(_text(__package__, OTHERS), OTHERS) if figure.method not in own)
    return tuple(found)


def published_by(entry: Entry) -> tuple[Figure, ...]:
    """Read the file that a method's entry declares; it can hold figures of that method alone.

    Raises UserInputError that says what is wrong in it, and whatever the package raises when it is imported.
    """
    declared = str(entry.declared["published"])
    named = DECLARED.fullmatch(declared)
    if named is None:
        raise UserInputError(f"published={declared!r}: it must be 'package:file.toml'")
    return read_figures(_text(named[1], named[2]), declared, entry.name)


def read_figures(text: str, where: str, method: str | None = None) -> tuple[Figure, ...]:
    """Read the text of a file of figures: every table's keys, then those of each of its figures, which win.

    where   what messages call the file
    method  whose figures they are; None: each table says it

    Raises UserInputError that names the first table and figure that is wrong.
    """
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserInputError(f"{where} is not valid TOML: {error}") from None
    unknown = sorted(content.keys() - {"tables", "protocols"})
    if unknown:
        raise UserInputError(f"{where}: unknown key '{unknown[0]}': it holds [[tables]] and [protocols.NAME]")
    protocols = {**shared_protocols(), **_protocols(content.get("protocols", {}), where)}
    found: list[Figure] = []
    for number, table in enumerate(_tables(content.get("tables", []), f"{where}: tables"), 1):
        here = f"{where}: table {number}"
        common = {name: value for name, value in table.items() if name != "figures"}
        for i, row in enumerate(_tables(table.get("figures", []), f"{here}: figures"), 1):
            found.append(_figure({**common, **row}, protocols, method, f"{here}, figure {i}"))
    return tuple(found)


@cache
def shared_protocols() -> Mapping[str, PublishedProtocol]:
    """The protocols that every file may name."""
    return _protocols(tomllib.loads(_text(__package__, PROTOCOLS)), PROTOCOLS)


def _figure(
    values: dict[str, Any], protocols: Mapping[str, PublishedProtocol], method: str | None, where: str
) -> Figure:
    if method is not None and "method" in values:
        raise UserInputError(f"{where}: leave out 'method': the file is of '{method}', whose entry declares it")
    name = values.get("protocol")
    if not isinstance(name, str) or name not in protocols:
        raise UserInputError(f"{where}: no protocol is called {name!r}; there are: {', '.join(protocols)}")
    given = {**values, "protocol": protocols[name]}
    if method is not None:
        given["method"] = method
    if isinstance(given.get("source"), str):
        given["source"] = given["source"].replace("{scene}", str(given.get("scene", "")))
    try:
        return Figure(**given)
    except ValidationError as error:
        raise UserInputError(f"{where}: {_first(error)}") from None


def _protocols(tables: Any, where: str) -> dict[str, PublishedProtocol]:
    if not isinstance(tables, dict):
        raise UserInputError(f"{where}: 'protocols' must be tables [protocols.NAME]")
    found = {}
    for name, values in tables.items():
        try:
            found[name] = PublishedProtocol.model_validate(values)
        except ValidationError as error:
            raise UserInputError(f"{where}: protocol {name}: {_first(error)}") from None
    return found


def _tables(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        raise UserInputError(f"{where} must be a list of tables")
    return value


def _first(error: ValidationError) -> str:
    """The first thing that is wrong."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def _text(package: str, name: str) -> str:
    """Text of a file in an installed package. Raises UserInputError where it is not there, or far too large."""
    path = files(package).joinpath(name)
    try:
        content = path.read_bytes()
        if len(content) > LARGEST_FILE:
            raise UserInputError(f"{package}:{name}: {len(content):,} bytes is too large for published figures")
        return content.decode("utf-8")
    except OSError as error:
        raise UserInputError(f"{package}:{name} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise UserInputError(f"{package}:{name} is not UTF-8") from None
