"""`sw truncate`: a file that declares cuts, ended at one of them; and how commands ask for a part of such a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.paths import INPUT_FILE, OUTPUT_FILE


def _size(context: click.Context, _parameter: click.Parameter, given: str | None) -> int | None:
    from splatwizard_core.base.values import parse_size

    if given is None:
        return None
    if context.params.get("packets") is not None:
        raise click.UsageError("--packets and a size each choose a cut: give one of them")
    return parse_size(given)


def part_options(size: str) -> Sequence[Callable[[shared.F], shared.F]]:
    """Return the options for a part of a file with cuts, parameters packets, size and partial; `size` is called so."""
    return (
        click.option("--packets", type=click.IntRange(min=1), metavar="P", is_eager=True,
                     help="With cuts: the first P packets.  [default: all]"),
        click.option(size, "size", metavar="SIZE", callback=_size,
                     help="With cuts: the packets that fit, as into 500kB or 2MiB.  [default: all]"),
        click.option("--partial", is_flag=True,
                     help="With cuts: the packets before the place where a file ends early or is damaged."),
    )  # fmt: skip


@click.command(short_help="a shorter file of one with cuts")
@click.argument("file", metavar="FILE.swz", type=INPUT_FILE)
@shared.options(
    *part_options("--size"),
    click.option("--out", metavar="SHORT.swz", type=OUTPUT_FILE, required=True, help="The file to write."),
    shared.json_option, shared.debug_option,
)  # fmt: skip
def truncate(file: Path, packets: int | None, size: int | None, partial: bool, out: Path, as_json: bool) -> None:
    """Copy FILE.swz up to a cut that it declares: SHORT.swz is a whole file of fewer packets, nothing is decoded.

    `sw info FILE.swz` lists the cuts. At least one of --packets, --size and --partial says which is meant.
    """
    from splatwizard_core.base.files import write_atomic
    from splatwizard_core.coding.container import ContainerReader
    from splatwizard_core.coding.cuts import Prefix
    from splatwizard_core.errors import UserInputError

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
    shared.print_facts(facts, as_json, told)
