"""`sw info`: what is in a file or a scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from splatwizard_core.api import ContainerReader, UserInputError
from splatwizard_core.tooling import (
    SCENE_OR_FILE,
    Choices,
    debug_option,
    existing,
    images_option,
    json_option,
    load_plugins,
    options,
    print_facts,
    print_table,
    set_option,
    takes_choices,
    without_orders,
    write_atomic,
)

INDEX = "lod-meta.json"
"""Of a streamed SOG."""


@click.command(short_help="what is in a file or scene")
@click.argument("path", metavar="PATH", type=SCENE_OR_FILE)
@click.option("--split", metavar="RULE", help="Split a scene by this rule, and draw it as .svg.  [default: no picture]")
@options(images_option, set_option, json_option, debug_option)
@takes_choices
def info(path: str, as_json: bool, chosen: Choices) -> None:
    """Show what is in PATH: a .swz file (bytes by section), a run directory (its file), a metrics.json (scores, and who
    served which phase), a .ply, or a scene (a folder, dataset/scene, or one that is made on the spot, by its name)."""
    from splatwizard_core.tooling import family_of

    if not path.strip():
        raise click.UsageError("PATH is empty")
    where = existing(path) if Path(path).exists() else Path(path)
    if (where / "scene.swz").is_file() and (where / "config.toml").is_file():
        where = where / "scene.swz"
    where = where / INDEX if (where / INDEX).is_file() else where
    show: Callable[[dict[str, Any]], None] = _print_plain
    if where.suffix == ".swz" or (where.is_file() and _head(where, 4) == b"SPWZ"):
        kind, facts, show = "file", _file_facts(where), _print_file
    elif where.suffix == ".json" and where.is_file() and where.name != INDEX and not _holds_gaussians(_head(where)):
        kind, facts, show = "record", _record_facts(where), _print_record
    elif (importer := load_plugins().importers.of_suffix(where)) is not None:
        kind, facts = importer, _gaussian_facts(where)
    elif where.is_file() and family_of(path, load_plugins().datasets) is None:
        kinds = sorted({e.declared["suffix"] for e in load_plugins().importers if e.declared.get("suffix")})
        raise UserInputError(f"{path}: no file that `sw info` can read: .swz, metrics.json, {', '.join(kinds)}")
    else:
        kind, facts = "scene", _scene_facts(path, chosen)
    print_facts({"kind": kind, **facts}, as_json, show)


def _holds_gaussians(text: bytes) -> bool:
    formats = ((b'"means"', b'"sh0"'), (b'"lodLevels"', b'"filenames"'))  # a SOG, an index of streamed ones
    return b'"protocol"' not in text and any(all(part in text for part in parts) for parts in formats)


def _head(path: Path, count: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error


def _file_facts(path: Path) -> dict[str, Any]:
    """Header and bytes by section of a .swz, which sum to its size; and what is missing here to decode it, and why."""
    from splatwizard_core.tooling import missing_plugin

    reader, plugins = ContainerReader.open(path), load_plugins()
    parts = [("method", reader.method), *(part for each in reader.requires for part in each.provided)]
    # What several installed plugins quarrel over is not missing.
    there = {(kind, n) for kind, each in plugins.registries.items() for n in (*each.names, *each.clashes)}
    missing = {f"{kind} {name}": str(missing_plugin(reader, plugins, kind, name))
               for kind, name in parts if (kind, name) not in there}  # fmt: skip
    return {"path": str(path), **reader.summary(), "missing": missing}


def _record_facts(path: Path) -> dict[str, Any]:
    """The gist of a result record: what was run, its scores, and who served which phase."""
    from splatwizard_core.tooling import read_record

    record = read_record(path).model_dump(mode="json")
    means = {name: metric["mean"] for name, metric in record["metrics"].items() if not metric["diagnostic"]}
    return {
        "path": str(path),
        **_part(record, "method", "distribution", "preset", "rate", "scene", "counts", "date"),
        "protocol": record["protocol"]["id"],
        "metrics": {name: mean for name, mean in means.items() if mean is not None},
        "bytes": record["file"]["bytes"],
        "raster_options": {phase: options for phase, options in record["raster_options"].items() if options},
        "phases": record["phases"],
        "train": _part(record["train"], "steps", "train_s", "with_pretraining_s", "pretraining"),
    }


def _part(facts: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: facts[name] for name in names}


def _gaussian_facts(path: Path) -> dict[str, Any]:
    from splatwizard_core.tooling import read_gaussians

    model = read_gaussians(existing(path), load_plugins())
    means, scales, opacities = model.means.detach(), model.scales.detach(), model.opacities.detach()
    facts = dict(model.origin)
    left = facts.pop("left_out", {"not_finite": 0, "zero_rotation": 0})
    return {
        "path": str(path),
        "size": path.stat().st_size,
        **facts,
        **model.counts(),
        **left,
        "sh_degree": model.max_sh_degree,
        "box": {"min": means.amin(0).tolist(), "max": means.amax(0).tolist()} if model.num_rows else None,
        "median_scale": float(scales.median()) if model.num_rows else None,
        "median_opacity": float(opacities.median()) if model.num_rows else None,
    }


def _scene_facts(spec: str, chosen: Choices) -> dict[str, Any]:
    from splatwizard_core.tooling import load_scene

    plugins = load_plugins()
    scene = load_scene(spec, chosen.resolve_without_method().scene, plugins)
    facts = {"name": scene.name} | {k: v for each in plugins.hook.describe_scene(scene=scene) for k, v in each.items()}
    pictures: dict[str, str] = facts.pop("pictures", {})
    for name, text in pictures.items() if chosen.split else ():
        write_atomic(Path(name), text)
    return facts | ({"pictures": [*pictures]} if chosen.split else {})


def _print_file(facts: dict[str, Any]) -> None:
    lines = [f"{facts['path']}: {facts['method']} (layout version {facts['method_version']})"]
    lines += [f"written with: {_shown(facts['requires'])}"] if facts["requires"] else []
    lines += [f"{name}: {_shown(facts[name])}" for name in ("raster", "static") if facts[name]]
    sections = [[name, f"{n:,}", f"{n / facts['size']:.1%}"] for name, n in facts["bytes"].items()]
    click.echo(without_orders("\n".join(lines)))
    total = ["file", f"{facts['size']:,}", "100.0%"]
    print_table(["section", "bytes", "share"], [*sections, [], total], right=2)
    if facts["cuts"]:
        rows = [[f"{cut['packets']}", f"{cut['bytes']:,}"] for cut in facts["cuts"]]
        heads = ["packets", "bytes"]
        if any(cut["psnr"] is not None for cut in facts["cuts"]):
            heads.append("PSNR of the training views, dB")
            for row, cut in zip(rows, facts["cuts"], strict=True):
                row.append("-" if cut["psnr"] is None else f"{cut['psnr']:.2f}")
        print_table(heads, rows, right=len(heads))
    if facts["packets"] < len(facts["cuts"]):
        click.echo(f"the file ends after packet {facts['packets']} of {len(facts['cuts'])}")
    for reason in facts["missing"].values():
        click.echo(without_orders(reason))


def _print_record(facts: dict[str, Any]) -> None:
    train, phases = facts.pop("train"), facts.pop("phases")
    _print_plain({**facts, "steps": train["steps"], "starts from": _started_from(train["pretraining"] or {})})
    if phases is None:
        click.echo("who served which phase is not known of this record")
        return
    rows: list[list[str]] = []
    for phase in phases:
        served: dict[str, list[str]] = {}
        for part in phase["provided_by"]:
            owner = f"{part['distribution']} {part['version']}".strip() or "no distribution"
            served.setdefault(owner, []).append(f"{part['kind']} {part['name']}")
        for i, (owner, parts) in enumerate((served or {"": ["-"]}).items()):
            rows.append(["" if i else phase["phase"], ", ".join(parts), owner])
        rows.append([])
    print_table(["phase", "provided by", "from"], rows)


def _started_from(pretraining: dict[str, dict[str, Any]]) -> str:
    """The start of a training, in words; empty: nothing that was trained."""
    forms = {"preset": "{} preset", "steps": "{:,} steps", "train_s": "{:.0f} s"}
    found = []
    for name, scene in pretraining.items():
        known = ", ".join(form.format(scene[key]) for key, form in forms.items() if scene[key] is not None)
        origin = f"from the file {scene['file']['name']}" if "name" in scene["file"] else f"({known})"
        found.append(f"a trained {name} scene {origin}")
    return "; ".join(found)


def _print_plain(facts: dict[str, Any]) -> None:
    known = {name: value for name, value in facts.items() if name != "kind" and value not in (None, "", [], {})}
    print_table([], [[name.replace("_", " "), _shown(value)] for name, value in known.items()])


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_shown(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ("; " if value and isinstance(value[0], dict) else ", ").join(map(_shown, value))
    return str(value)
