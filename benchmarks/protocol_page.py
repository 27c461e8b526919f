"""Put the tables of `protocol_tables.py` into docs/other_protocols.md, figures beside it, its CSV files to the records.

    python benchmarks/protocol_page.py out/protocols

Only what stands between the page's two marks is replaced. A section that OUT/tables.md lacks keeps what the page has
of it, which may be that it is not measured yet.
"""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "other_protocols.md"
MADE = re.compile(r"(<!-- made by benchmarks/protocol_page.py -->\n).*?(<!-- end -->)", re.S)
RECORDS = ("gsc.csv", "gsc_bd.csv", "correlations.csv", "splits.csv", "distances.csv")
FIGURES = {"chair": "chair", "room": "room", "room@2": "room, its second protocol"}
"""Scenes whose sheet of distances the page shows, and what they are called."""


def sections(text: str) -> dict[str, str]:
    """Text of each section by its heading, the heading included."""
    parts = re.split(r"^(?=## )", text, flags=re.M)
    return {part.partition("\n")[0]: part.strip() + "\n" for part in parts if part.startswith("## ")}


def kind(heading: str) -> str:
    """Words that tell which section a heading is of; further ones say of which scene."""
    return " ".join(heading.split()[:3])


def filled(page: str, tables: str) -> str:
    """The page with the sections of `tables` in place of its own of the same kind; figures that are there are shown."""
    found = MADE.search(page)
    if found is None:
        raise SystemExit(f"{PAGE} has no marks")
    new = {kind(heading): text for heading, text in sections(tables).items()}
    old = sections(found[0].removesuffix("<!-- end -->"))
    kept = [new.pop(kind(heading), text) for heading, text in old.items()]
    content = "\n".join([*kept, *new.values()])
    return MADE.sub(lambda match: f"{match[1]}\n{content}\n{match[2]}", page)


def figures(out: Path) -> list[str]:
    """Lines that show the figures of distances which OUT has, copied beside the page."""
    lines = []
    for name, told in FIGURES.items():
        drawn = out / "figures" / f"distance-{name}.svg"
        if drawn.is_file():
            kept = drawn.name.replace("@", "-")
            shutil.copyfile(drawn, PAGE.parent / "images" / kept)
            lines += ["", f"![{told}: means of four groups of test views against their distance](images/{kept})"]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of protocol_tables.py")
    args = parser.parse_args()
    tables = (args.out / "tables.md").read_text() + "\n".join(figures(args.out)) + "\n"
    PAGE.write_text(filled(PAGE.read_text(), tables))
    records = ROOT / "docs" / "records" / "protocols"
    records.mkdir(exist_ok=True)
    for name in RECORDS:
        if (args.out / name).is_file() and (args.out / name).read_text().count("\n") > 1:
            shutil.copyfile(args.out / name, records / name)
    print(f"written: {PAGE}, {records}")


if __name__ == "__main__":
    main()
