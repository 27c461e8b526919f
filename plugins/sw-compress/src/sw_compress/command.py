"""`sw compress`: any splat file to a size or a quality, without its photographs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_FILE,
    OUTPUT_FOLDER,
    ForeseenError,
    debug_option,
    device_option,
    existing_file,
    json_option,
    options,
    print_facts,
    say,
)
from sw_compress.targets import Target

if TYPE_CHECKING:
    from sw_compress.compressing import Compressed

FORMATS = ("swz", "sog", "spz")
"""Suffixes of what is written; the first is usual."""
INDICES = ("lod-meta.json", "meta.json")
"""Files that stand for the folder that they lie in."""


@click.command(short_help="any splat file to a size, without photographs")
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@options(
    click.option("--size", metavar="SIZE",
                 help="Bytes of the result at most: 8MB, 8MiB, 800kB or a number.  [default: as --quality says]"),
    click.option("--quality", metavar="DB",
                 help="PSNR against the source's own pictures.  [default: 40dB, without another target]"),
    click.option("--ratio", metavar="N", help="How many times smaller than the source.  [default: as --quality says]"),
    click.option("--out", metavar="PATH", type=click.Path(),
                 help="The file to write; of several files a folder.  [default: beside the source]"),
    click.option("--format", "format_name", type=click.Choice(FORMATS),
                 help="What is written: .swz is the smallest.  [default: by the suffix of --out, else swz]"),
    click.option("--cameras", type=EXISTING, metavar="FILE",
                 help="JSON of cameras (README of sw-view).  [default: they are made up]"),
    click.option("--views", type=click.IntRange(min=3), metavar="N",
                 help="Cameras that are made up, a third of them set aside.  [default: 18 to 120, by device and size]"),
    click.option("--gaussians", type=click.IntRange(min=1), metavar="N",
                 help="Gaussians that stay: the most significant ones.  [default: what gives the best picture]"),
    click.option("--sh-degree", type=click.IntRange(0, 3), metavar="D",
                 help="Highest degree of the spherical harmonics.  [default: the source's]"),
    click.option("--drop-unseen", is_flag=True, help="Let go what no camera shows."),
    click.option("--refine", type=click.FloatRange(0, 86_400), default=0.0, metavar="SECONDS",
                 help="Train what stays on pictures of the source for so long, .swz alone.  [default: 0, not]"),
    device_option, json_option, debug_option,
)  # fmt: skip
def compress(
    files: tuple[Path, ...], size: str | None, quality: str | None, ratio: str | None, out: str | None,
    format_name: str | None, cameras: Path | None, views: int | None, gaussians: int | None, sh_degree: int | None,
    drop_unseen: bool, refine: float, device: str | None, as_json: bool,
) -> None:  # fmt: skip
    """Make FILE small without its photographs: fewer Gaussians, each as precise as its part in the picture asks for.

    FILE is any splat file: .ply, .spz, .splat, .sog, .ksplat, .glb, or a .swz. With --size the result has 99 to 100 %
    of it, less for some thousand Gaussians (which is told), never more. Cameras are made up from the scene, and a third
    of them only measures: the PSNR is against pictures of the source, and a line says what it would cost against
    photographs.

    Of several files each is made to the same target; where one cannot be, the others are. A file that is already there
    is replaced only where --out names it.
    """
    # What can be said about the options is said before torch is loaded.
    Target.of(size, quality, ratio, 0)
    format_name = _format(format_name, out if len(files) == 1 else None)
    places = _places(files, out, f".{format_name}")
    if len(files) == 1:
        existing_file(files[0])
    from sw_compress.compressing import compress as make

    records: list[dict[str, Any]] = []
    failed: list[ForeseenError] = []
    for file, place in zip(files, places, strict=True):
        try:
            existing_file(file)
            with _there(place.parent):
                done = make(
                    file, size=size, quality=quality, ratio=ratio, out=place, format=format_name, cameras=cameras,
                    views=views, gaussians=gaussians, sh_degree=sh_degree, drop_unseen=drop_unseen, refine=refine,
                    device=device or "auto", say=say,
                )  # fmt: skip
        except ForeseenError as error:
            if len(files) == 1:
                raise
            say(f"{'' if str(file) in str(error) else f'{file}: '}{error}")
            failed.append(error)
            continue
        records.append(done.record)
        if not as_json:
            click.echo(_told(done))
    if as_json:
        print_facts(records[0] if len(files) == 1 else {"files": records}, True, "")
    if failed:
        raise click.ClickException(f"{len(failed)} of {len(files)} files failed")


@contextlib.contextmanager
def _there(folder: Path) -> Iterator[None]:
    """Make a folder for the block, and remove it again if nothing comes into it."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # there is something in it
            for each in made:
                each.rmdir()


def _format(asked: str | None, out: str | None) -> str:
    """Return the format asked for, or that of the name of the result. Raises UserInputError where they differ."""
    suffix = "" if out is None else Path(out).suffix.lower().removeprefix(".")
    if suffix and suffix not in ((asked,) if asked else FORMATS):
        which = asked or ", ".join(FORMATS)
        raise UserInputError(f"{out}: a file of this name would hold {which}: give --out FILE.{asked or FORMATS[0]}")
    return asked or suffix or FORMATS[0]


def _places(files: tuple[Path, ...], out: str | None, suffix: str) -> list[Path]:
    """Return the place of each result. Raises UserInputError for one that is a source, that two share, or,
    where nobody named it, that is there."""
    if len(files) == 1:
        places = [OUTPUT_FILE.check(out if out is not None else default_output(files[0], suffix))]
    elif out is None:
        places = [OUTPUT_FILE.check(default_output(file, suffix)) for file in files]
    else:
        if Path(out).suffix.lower() in (f".{name}" for name in FORMATS) and not Path(out).is_dir():
            raise UserInputError(f"--out {out} names one file, and there are {len(files)} to compress: name a folder")
        folder = OUTPUT_FOLDER.check(out)
        places = [folder / default_output(file, suffix).name for file in files]
    sources = {file.resolve() for file in files}
    for place in places:
        if place.resolve() in sources:
            raise UserInputError(f"{place} is a source, and would be replaced: give another --out")
        if out is None and place.exists():
            raise UserInputError(f"{place} is there already: give --out FILE, that one to replace it")
        if places.count(place) > 1:
            raise UserInputError(
                f"two results would be {place}: compress them one by one, or into folders of their own"
            )
    return places


def default_output(path: Path, suffix: str) -> Path:
    """Path beside the source with the suffix of the format; of a folder with its index, beside the folder."""
    path = path.resolve().parent if path.name.lower() in INDICES else path
    found = path.with_suffix(suffix)
    return found if found != path else path.with_name(f"{path.stem}-small{suffix}")


def _told(done: Compressed) -> str:
    record = done.record
    source = record["source"]
    times = f"{source['bytes'] / record['bytes']:.1f} x smaller than {source['file']}, "
    counts = f"{record['gaussians']:,} of {source['gaussians']:,} Gaussians"
    return (
        f"{done.out}: {record['bytes']:,} bytes, {times}{counts}, in {record['seconds']['total']:.1f} s\n"
        f"  {record['told']}"
    )
