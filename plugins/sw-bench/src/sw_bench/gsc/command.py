"""`sw bench --protocol mpeg-gsc`: from the options of the command to the protocol, and its tables on the terminal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import Choices, load_plugins, open_session, print_facts, print_table
from sw_bench.gsc.frames import frame_files, sequence_of
from sw_bench.gsc.protocol import ALPHA_MAX, ANCHOR, Plan, bench_gsc
from sw_bench.gsc.views import Asked, size_of

OPTIONS = {
    "anchor": None, "path": ("auto", "orbit16", "inside16"), "up": None, "quaternion": ("w2c", "c2w"),
    "range": ("auto", "fixed"), "alpha_max": ("0.99", "0.999"),
}  # fmt: skip
"""Keys of -o, with their values where these are few."""
OF_VIEWS = ("path", "up", "quaternion")
USELESS = ("scene", "seed", "preset", "images", "init", "config_file", "geometry", "executor", "dry_run", "rate")
"""Options of sweeps, which mean nothing here."""


def bench_models(
    paths: tuple[str, ...],
    given: dict[str, Any],
    *,
    cameras: Path | None,
    views: str | None,
    size: str | None,
    frames: str | None,
) -> None:
    """Run the protocol on files, and print it. Raises UserInputError, click.UsageError."""
    if bool(paths) == (frames is not None):
        raise click.UsageError("--protocol mpeg-gsc: give one or more trained models FILE..., or --frames")
    if useless := [name for name in USELESS if given.get(name) not in (None, (), "", False)]:
        raise click.UsageError(f"--{useless[0].removesuffix('_file').replace('_', '-')} is of no use with --protocol")
    for path in paths:
        if not Path(path).is_file():
            raise UserInputError(f"{path}: there is no such file")
    options = options_of(given["given"])
    chosen = Choices(sets=tuple(given["sets"]), device=given["device"])
    plugins, alpha_max = load_plugins(), float(options.get("alpha_max", ALPHA_MAX))
    fitting = [e.name for e in plugins.rasterizers if e.declared.get("alpha_max", ALPHA_MAX) == alpha_max]
    prefer = () if alpha_max == ALPHA_MAX else (f"raster.prefer={json.dumps(fitting)}",)
    resolved = Choices(device=given["device"], sets=prefer).resolve_without_method()
    session = open_session(resolved, plugins)
    plan = Plan(
        files=[Path(path) for path in paths] if frames is None else frame_files(frames),
        sequence=None if frames is None else sequence_of(frames),
        alpha_max=alpha_max,
        out=Path(given["out"] or "out") / "mpeg-gsc",
        codecs=[name.strip() for text in given["methods"] for name in text.split(",") if name.strip()],
        anchor=options.get("anchor", ANCHOR),
        asked=Asked(
            cameras,
            views,
            size_of(size),
            options.get("up"),
            options.get("path", "auto"),
            options.get("quaternion", "w2c"),
        ),
        sets=chosen.sets,
        range=options.get("range", "auto"),
    )
    plan.out.mkdir(parents=True, exist_ok=True)
    print_facts(bench_gsc(plan, session, resolved), given["as_json"], lambda facts: tell(facts, plan.out))


def options_of(given: tuple[str, ...]) -> dict[str, str]:
    """Values of -o by key. Raises click.UsageError for an unknown key or value."""
    found = {}
    for text in given:
        key, separator, value = text.partition("=")
        if not separator or key not in OPTIONS:
            raise click.UsageError(f"-o {text}: with --protocol mpeg-gsc give {', '.join(f'{k}=...' for k in OPTIONS)}")
        allowed = OPTIONS[key]
        if allowed is not None and value not in allowed:
            raise click.UsageError(f"-o {text}: give one of {', '.join(allowed)}")
        found[key] = value
    return found


def tell(facts: dict[str, Any], out: Path) -> None:
    """Print the rows, and the BD-rates against the anchor."""
    click.echo(f"{facts['protocol']}; quality against renders of the source model")
    pooled = any(row["infinite_views"] for row in facts["rows"])
    names = [
        "codec",
        "rate",
        "bytes",
        "bits/splat",
        "PSNR RGB",
        *(["pooled"] if pooled else []),
        "PSNR YUV",
        "SSIM YUV",
    ]
    for source in facts["sources"]:
        rows = [row for row in facts["rows"] if row["sequence"] == source["sequence"]]
        title = f"{source['sequence']}: {source['splats']:,} splats, {len(source['views'])} views, {source['protocol']}"
        photos = any("photos" in row for row in rows)
        head = [*names, *(["photos: PSNR", "drop"] if photos else []), "encode s", "decode s"]
        print_table(head, [_cells(row, pooled=pooled, photos=photos) for row in rows], title=title, right=len(head) - 2)
    if facts["bd"]:
        head = ["scene", "codec", "BD-rate RGB", "YUV", "SSIM", ""]
        rows = [
            [row["sequence"], row["codec"], *(_percent(row[f"bd_{n}"]) for n in ("psnr_rgb", "psnr_yuv", "ssim_yuv")),
             row["note"]]
            for row in facts["bd"]
        ]  # fmt: skip
        print_table(head, rows, title=f"BD-rates against {facts['anchor']}, %")
    click.echo(f"written: {out / 'gsc.csv'}, gsc_bd.csv, gsc.json")


def _cells(row: dict[str, Any], *, pooled: bool, photos: bool) -> list[str]:
    if row["bytes"] is None:
        return [row["codec"], row["rate"], row["flags"]]
    db = ["psnr_rgb", *(["psnr_rgb_pooled"] if pooled else []), "psnr_yuv"]
    cells = [row["codec"], row["rate"], f"{row['bytes']:,}", f"{row['bits_per_splat']:.1f}"]
    cells += ["equal" if row[name] is None else f"{row[name]:.2f}" for name in db]
    cells.append(f"{row['ssim_yuv']:.4f}")
    if photos:
        found = row.get("photos", {}).get("psnr")
        cells += ["-", "-"] if found is None else [f"{found['decoded']:.2f}", f"{found['drop']:.2f}"]
    return [*cells, f"{row['enc_s']:.2f}", f"{row['dec_s']:.2f}"]


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:+.1f}"
