"""`sw truncate`: a file that declares cuts, ended at one of them."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.api import ContainerReader, UserInputError
from splatwizard_core.tooling import (
    INPUT_FILE,
    OUTPUT_FILE,
    Prefix,
    debug_option,
    json_option,
    options,
    part_options,
    print_facts,
    write_atomic,
)


@click.command(short_help="a shorter file of one with cuts")
@click.argument("file", metavar="FILE.swz", type=INPUT_FILE)
@options(
    *part_options("--size"),
    click.option("--out", metavar="SHORT.swz", type=OUTPUT_FILE, required=True, help="The file to write."),
    json_option, debug_option,
)  # fmt: skip
def truncate(file: Path, packets: int | None, size: int | None, partial: bool, out: Path, as_json: bool) -> None:
    """Copy FILE.swz up to a cut that it declares: SHORT.swz is a whole file of fewer packets, nothing is decoded.

    `sw info FILE.swz` lists the cuts. At least one of --packets, --size and --partial says which is meant.
    """
    if packets is None and size is None and not partial:
        raise click.UsageError("give --packets P, --size SIZE or --partial: `sw info FILE.swz` lists the cuts")
    reader = ContainerReader.open(file, Prefix(packets, size, partial))
    if not reader.cuts:
        raise UserInputError(f"{file}: it declares no cuts, there is no shorter file in it")
    if out.suffix != ".swz" or out.resolve() == file.resolve():
        raise UserInputError(f"{out}: give --out another file than the source, with a name that ends in .swz")
    with file.open("rb") as source:
        write_atomic(out, source.read(reader.size))
    facts = {"file": str(out), "packets": reader.packets, "bytes": reader.size}
    told = f"{reader.packets} of {len(reader.cuts)} packets, {reader.size:,} of {file.stat().st_size:,} bytes: {out}"
    print_facts(facts, as_json, told)
