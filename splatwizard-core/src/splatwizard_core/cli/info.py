"""`sw info`: what is in a file or a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    console,
    debug_option,
    images_option,
    json_option,
    options,
    print_json,
    set_option,
)


@click.command(short_help="what is in a file or scene")
@click.argument("path", metavar="PATH", shell_complete=complete.scene_or_file)
@options(images_option, set_option, json_option, debug_option)
def info(path: str, images: str | None, sets: tuple[str, ...], as_json: bool) -> None:
    """What is in PATH: a .swz file (bytes by section), a run directory (its file), a metrics.json (scores, and who
    served which phase), a .ply, or a scene (folder, `demo`, dataset/scene)."""
    if not path.strip():
        raise click.UsageError("PATH is empty")
    where = Path(path)
    if (where / "scene.swz").is_file() and (where / "config.toml").is_file():
        where = where / "scene.swz"
    if where.suffix == ".swz" or (where.is_file() and _starts_with(where, b"SPWZ")):
        facts = {"kind": "file", **file_facts(where)}
    elif where.suffix == ".json" and where.is_file():
        facts = {"kind": "record", **_record_facts(where)}
    elif where.suffix == ".ply":
        facts = {"kind": "ply", **_ply_facts(where)}
    else:
        facts = {"kind": "scene", **_scene_facts(path, images, sets)}
    if as_json:
        print_json(facts)
    else:
        printers = {"file": _print_file, "record": _print_record, "ply": _print_plain, "scene": _print_plain}
        printers[facts["kind"]](facts)


def _starts_with(path: Path, magic: bytes) -> bool:
    from splatwizard_core.errors import UserInputError

    try:
        with path.open("rb") as file:
            return file.read(len(magic)) == magic
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error


def file_facts(path: Path) -> dict[str, Any]:
    """Header and bytes by section of a .swz, which sum to its size; and what is missing here to decode it, and why."""
    from splatwizard_core.coding.container import ContainerReader
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.file_needs import missing_parts, missing_plugin

    reader, plugins = ContainerReader.open(path), load_plugins()
    missing = {f"{kind} {name}": str(missing_plugin(reader, plugins, kind, name))
               for kind, name in missing_parts(reader, plugins)}  # fmt: skip
    return {"path": str(path), **reader.summary(), "missing": missing}


def _record_facts(path: Path) -> dict[str, Any]:
    """The gist of a result record: what was run, its scores, and who served which phase."""
    from splatwizard_core.runs.record import read_record

    record = read_record(path)
    return {
        "path": str(path),
        **record.model_dump(
            mode="json", include={"method", "distribution", "preset", "rate", "scene", "date", "counts"}
        ),
        "protocol": record.protocol.id,
        "metrics": {n: m.mean for n, m in record.metrics.items() if not m.diagnostic and m.mean is not None},
        "bytes": record.file.bytes,
        **record.model_dump(mode="json", include={"phases"}),
        "train": record.train.model_dump(
            mode="json", include={"steps", "train_s", "with_pretraining_s", "pretraining"}
        ),
    }


def _print_record(facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table
    from sw_report.facts import PhaseFacts, TrainFacts

    train = TrainFacts.model_validate(facts["train"])
    gist = {k: v for k, v in facts.items() if k not in ("phases", "train")} | {"steps": train.steps}
    gist["starts from"] = train.started_from()
    _print_plain({k: v for k, v in gist.items() if v != ""})
    if facts["phases"] is None:
        console().print("who served which phase is not known of this record")
        return
    table = Table()
    for name in ("phase", "provided by", "from"):
        table.add_column(name, overflow="fold")
    for phase in facts["phases"]:
        served = PhaseFacts.model_validate(phase).by_distribution() or {"": ["-"]}
        for i, (owner, parts) in enumerate(served.items()):
            name = "" if i else phase["phase"]
            table.add_row(escape(name), escape(", ".join(parts)), escape(owner), end_section=i == len(served) - 1)
    console().print(table)


def _ply_facts(path: Path) -> dict[str, Any]:
    from splatwizard_core.cli.setup import existing
    from splatwizard_core.gaussians.ply import load_ply

    model = load_ply(existing(str(path)))
    means, scales, opacities = model.means.detach(), model.scales.detach(), model.opacities.detach()
    sound = means.isfinite().all(1) & scales.isfinite().all(1) & opacities.isfinite()
    known = bool(sound.any())  # else there is no box and no median
    return {
        "path": str(path),
        "size": path.stat().st_size,
        **model.counts(),
        "not_finite": int((~sound).sum()),
        "sh_degree": model.max_sh_degree,
        "box": {"min": means[sound].amin(0).tolist(), "max": means[sound].amax(0).tolist()} if known else None,
        "median_scale": float(scales[sound].median()) if known else None,
        "median_opacity": float(opacities[sound].median()) if known else None,
    }


def _scene_facts(spec: str, images: str | None, sets: tuple[str, ...]) -> dict[str, Any]:
    from splatwizard_core.cli.describe_scene import describe
    from splatwizard_core.cli.setup import resolve_run_options
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.scene.loading import load_scene

    _, options_, _ = resolve_run_options(None, assignments(sets, images=images))
    return describe(load_scene(spec, options_, load_plugins()))


def _print_file(facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    out = console()
    out.print(escape(f"{facts['path']}: {facts['method']} (layout version {facts['method_version']})"), soft_wrap=True)
    if facts["requires"]:
        out.print(escape(f"written with: {_shown(facts['requires'])}"), soft_wrap=True)
    for name in ("raster", "static"):
        if facts[name]:
            out.print(escape(f"{name}: {_shown(facts[name])}"), soft_wrap=True)
    table = Table()
    table.add_column("section")
    table.add_column("bytes", justify="right")
    table.add_column("share", justify="right")
    for name, size in facts["bytes"].items():
        table.add_row(escape(name), f"{size:,}", f"{size / facts['size']:.1%}")
    table.add_section()
    table.add_row("file", f"{facts['size']:,}", "100.0%")
    out.print(table)
    for reason in facts["missing"].values():
        out.print(escape(reason), soft_wrap=True)


def _print_plain(facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False)
    for name, value in facts.items():
        if name != "kind" and value not in (None, [], {}):
            table.add_row(name.replace("_", " "), escape(_shown(value)))
    console().print(table)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_shown(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(map(_shown, value)) if value and isinstance(value[0], dict) else ", ".join(map(_shown, value))
    return str(value)
