"""`sw encode` and `sw decode`: a trained model to one file, and a file back to a model."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.complete import complete_files
from splatwizard_core.cli.paths import existing, existing_file, output_file
from splatwizard_core.cli.setup import Choices, open_session, takes_choices
from splatwizard_core.plugins import load_plugins


@click.command(short_help="a trained model to one file")
@click.argument("source", metavar="SOURCE", shell_complete=complete_files)
@shared.options(
    click.option(
        "--out", metavar="FILE", shell_complete=complete_files,
        help="The file to write.  [default: scene.swz beside SOURCE]",
    ),
    shared.method_option, shared.rate_option, shared.preset_option, shared.config_option, shared.set_option,
    shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def encode(source: str, out: str | None, as_json: bool, chosen: Choices) -> None:
    """Encode SOURCE into one .swz file.

    SOURCE is a run directory whose training is finished (its config.toml holds; --rate and --set change values of the
    codec), or a .ply of explicit Gaussians, for methods that encode such.
    """
    from splatwizard_core.runs.encode import encode_directory, encode_ply

    path, plugins = existing(source), load_plugins()
    target = output_file(out if out is not None else (path if path.is_dir() else path.parent) / "scene.swz")
    if path.is_dir() and chosen.config_file is None:
        existing(str(path / "config.toml"))
        chosen = chosen.with_rate_of(path, plugins)
    resolved = chosen.resolve_one(plugins)
    session = open_session(resolved, plugins)
    facts = (encode_directory if path.is_dir() else encode_ply)(session, resolved, path, target)
    told = f"{facts['bytes']:,} bytes in {facts['encode_s']:.2f} s: {target}"
    shared.print_facts({"file": str(target), **facts}, as_json, told)


@click.command(short_help="a file back to a model, from nothing but itself")
@click.argument("file", metavar="FILE.swz", shell_complete=complete_files)
@shared.options(
    click.option(
        "--out", metavar="FILE", shell_complete=complete_files,
        help="Where to put the decoded model: .safetensors holds its tensors, other suffixes go to an exporter (.ply). "
        " [default: it is not kept]",
    ),
    click.option(
        "--repeats", type=click.IntRange(min=0), default=3, show_default=True, metavar="N",
        help="Timed decodes after the first one; their median is reported.",
    ),
    shared.set_option, shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def decode(file: str, out: str | None, repeats: int, as_json: bool, chosen: Choices) -> None:
    """Decode FILE.swz from nothing but itself; report time, counts and the digest of the model."""
    from splatwizard_core.runs.decode import save_decoded, timed_decode

    path, plugins = existing_file(file), load_plugins()
    if out is not None:
        output_file(out)
    session = open_session(chosen.resolve_without_method(), plugins)
    model, report = timed_decode(path, session, repeats=repeats)
    facts = asdict(report)
    if out is not None:
        save_decoded(model, report, Path(out), plugins)
        facts["out"] = out
    told = f"{shared.counted(report.counts)}, decoded in {report.decode_s:.3f} s on {report.device}"
    shared.print_facts(facts, as_json, f"{report.method}: {told}\nmodel digest {report.digest}")
