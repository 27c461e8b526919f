"""`sw lod`: a scene in pieces and levels, so that a viewer loads what it shows."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.tooling import (
    EXISTING,
    debug_option,
    device_option,
    json_option,
    options,
    print_facts,
    say,
    several,
)


class Count(click.ParamType):  # type: ignore[type-arg]  # generic only in new releases of click
    """A number of Gaussians, also as 64k or 1M."""

    name = "count"

    def convert(self, value: str | int, param: click.Parameter | None, ctx: click.Context | None) -> int:
        text = str(value).strip()
        times = {"k": 1024, "M": 1 << 20}.get(text[-1:], 1)
        digits = text[:-1] if times > 1 else text
        if not digits.isascii() or not digits.isdigit() or len(digits) > 9:
            self.fail(f"{text!r} is no number of Gaussians, such as 64k", param, ctx)
        return int(digits) * times


@click.command(short_help="a scene in pieces and levels, for streaming")
@click.argument("file", metavar="FILE", type=EXISTING)
@options(
    click.option("--out", metavar="PATH", required=True, type=click.Path(),
                 help="DIR/lod-meta.json: streamed SOG, for SuperSplat's viewer and PlayCanvas. Or FILE.swz."),
    click.option("--levels", type=click.IntRange(1, 64), metavar="N",
                 help="Of streamed SOG, each half of the one before.  [default: down to a 64th, at least 20,000]"),
    click.option("--chunk", type=Count(), metavar="N",
                 help="Gaussians of a piece at most, all its levels together.  [default: 64k; of a .swz 16k]"),
    device_option, json_option, debug_option,
)  # fmt: skip
def lod(file: Path, out: str, levels: int | None, chunk: int | None, device: str | None, as_json: bool) -> None:
    """Write FILE in levels of detail and in pieces: a viewer loads what it shows, as finely as it needs.

    FILE is any splat file: .ply, .spz, .splat, .sog, .ksplat, .glb, or a .swz of explicit Gaussians. Each level has
    half as many Gaussians as the finer one: neighbours merge where it shows least. The pieces of a level lie in folders
    beside the index, each a SOG of its own.

    A .swz has the whole scene coarsely, then piece by piece as it is: a file that ends after any of them is a scene
    (`sw info`, `sw truncate`, `sw decode --packets`).
    """
    from sw_lod.writing import write_lod

    record = write_lod(file, out, levels=levels, chunk=chunk, device=device or "auto", say=say)
    if "packets" in record:
        ends = record["packets"]
        packets = several(len(ends), "packet")
        told = f"{record['out']}: {ends[-1]:,} bytes in {packets}, the whole scene coarsely in {ends[0]:,}"
        print_facts(record, as_json, told)
        return
    counts = ", ".join(f"{count:,}" for count in record["counts"])
    told = (
        f"{record['out']}: {several(len(record['counts']), 'level')} ({counts} Gaussians) in "
        f"{several(record['leaves'], 'piece')}, {several(record['units'], 'unit')} of {record['bytes']:,} bytes"
    )
    for line in record["warnings"]:
        say(line)
    print_facts(record, as_json, told)
