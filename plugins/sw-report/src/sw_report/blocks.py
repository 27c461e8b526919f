"""Parts of a page: tables, groups of charts, galleries, under headings. The template draws them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from markupsafe import Markup

from sw_report.pictures import Gallery


@dataclass(frozen=True)
class Column:
    """text: left-aligned; long: may break into lines; code: in a typewriter's letters.

    key         what `--columns` calls it; empty: it cannot be left out
    better      "higher" or "lower"; empty: neither
    """

    name: str
    text: bool = False
    long: bool = False
    code: bool = False
    key: str = ""
    better: str = ""


class Note(str):
    """A line under a table, and the keys of the columns that it is about; without any it is about all."""

    about: frozenset[str]

    def __new__(cls, text: str, *about: str) -> Note:
        found = super().__new__(cls, text)
        found.about = frozenset(about)
        return found


@dataclass(frozen=True)
class Cell:
    """`share` (0..1) draws a bar of that width in colour `style` instead of text; `best`: of its column."""

    text: str
    title: str = ""
    share: float | None = None
    style: int = 0
    best: bool = False


@dataclass(frozen=True)
class Row:
    cells: list[Cell]
    emphasis: bool = False


@dataclass(frozen=True)
class Table:
    """Table whose first column names the rows; a click on a heading sorts a `sortable` one."""

    title: str
    columns: list[Column]
    rows: list[Row]
    caption: str = ""
    notes: list[str] = field(default_factory=list)
    wide: bool = False
    sortable: bool = False

    @property
    def has_best(self) -> bool:
        """Whether a cell is marked as the best of its column."""
        return any(cell.best for row in self.rows for cell in row.cells)


@dataclass(frozen=True)
class Figure:
    caption: str
    svg: Markup


@dataclass(frozen=True)
class Charts:
    """Charts side by side that share a legend of (key, name)."""

    figures: list[Figure]
    legend: list[tuple[Markup, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Part:
    """One thing under an optional heading; `folded` hides it behind that line until it is asked for."""

    heading: str = ""
    text: str = ""
    table: Table | None = None
    charts: Charts | None = None
    gallery: Gallery | None = None
    folded: str = ""


@dataclass(frozen=True)
class Section:
    """`id` is an anchor inside the page; `short` names the section in the contents."""

    id: str
    title: str
    parts: list[Part]
    text: str = ""
    short: str = ""


def row(cells: Iterable[str | Cell], *, emphasis: bool = False) -> Row:
    """A row from texts and cells."""
    return Row([cell if isinstance(cell, Cell) else Cell(cell) for cell in cells], emphasis)


def columns(names: Sequence[str], *, text: Sequence[str] = (), long: Sequence[str] = ()) -> list[Column]:
    """Columns by name; those in `text` are left-aligned, those in `long` too and may break."""
    return [Column(name, name in text or name in long, name in long) for name in names]
