"""`sw encode` and `sw decode`: a trained model to one file, and a file back to a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    config_option,
    debug_option,
    device_option,
    json_option,
    method_option,
    options,
    preset_option,
    print_json,
    rate_option,
    set_option,
)
from splatwizard_core.cli.setup import (
    existing,
    existing_file,
    open_session,
    output_file,
    rate_values,
    resolve_one,
    resolve_run_options,
)


@click.command(short_help="a trained model to one file")
@click.argument("source", metavar="SOURCE", shell_complete=complete.files)
@options(
    click.option(
        "--out", metavar="FILE", shell_complete=complete.files,
        help="The file to write.  [default: scene.swz beside SOURCE]",
    ),
    method_option, rate_option, preset_option, config_option, set_option, device_option, json_option, debug_option,
)  # fmt: skip
def encode(
    source: str,
    out: str | None,
    method: str | None,
    rate: str | None,
    preset: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    device: str | None,
    as_json: bool,
) -> None:
    """Encode SOURCE into one .swz file.

    SOURCE is a run directory whose training is finished (its config.toml holds; --rate and --set change values of the
    codec), or a .ply of explicit Gaussians, for methods that encode such.
    """
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.encode import encode_directory, encode_ply

    path = existing(source)
    plugins = load_plugins()
    values = assignments(sets, device=device)
    target = output_file(out if out is not None else (path if path.is_dir() else path.parent) / "scene.swz")
    if path.is_dir() and config_file is None:
        config_file = str(existing(str(path / "config.toml")))
        if rate is not None:
            values, rate = {**rate_values(plugins, method, rate, config_file), **values}, None
    resolved = resolve_one(plugins, method, rate, preset=preset, config_file=config_file, values=values, scene=None)
    session = open_session(resolved.ppl, plugins)
    if path.is_dir():
        facts = encode_directory(session, resolved, path, target)
    else:
        facts = encode_ply(session, resolved, path, target)
    if as_json:
        print_json({"file": str(target), **facts})
    else:
        click.echo(f"{facts['bytes']:,} bytes in {facts['encode_s']:.2f} s: {target}")


@click.command(short_help="a file back to a model, from nothing but itself")
@click.argument("file", metavar="FILE.swz", shell_complete=complete.files)
@options(
    click.option(
        "--out", metavar="FILE", shell_complete=complete.files,
        help="Where to put the decoded model: .safetensors holds its tensors, other suffixes go to an exporter (.ply). "
        " [default: it is not kept]",
    ),
    click.option(
        "--repeats", type=click.IntRange(min=0), default=3, show_default=True, metavar="N",
        help="Timed decodes after the first one; their median is reported.",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
def decode(file: str, out: str | None, repeats: int, device: str | None, as_json: bool) -> None:
    """Decode FILE.swz from nothing but itself; report time, counts and the digest of the model."""
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.decode import save_decoded, timed_decode

    path = existing_file(file)
    if out is not None:
        output_file(out)
    plugins = load_plugins()
    ppl, _, _ = resolve_run_options(None, assignments((), device=device))
    session = open_session(ppl, plugins)
    model, report = timed_decode(path, plugins, session.device, repeats=repeats, load_kernels=session.load_kernels)
    facts: dict[str, Any] = report.as_dict()
    if out is not None:
        save_decoded(model, report, Path(out), plugins)
        facts["out"] = out
    if as_json:
        print_json(facts)
        return
    counted = ", ".join(f"{n:,} {name.removeprefix('num_')}" for name, n in report.counts.items())
    click.echo(f"{report.method}: {counted}, decoded in {report.decode_s:.3f} s on {report.device}")
    click.echo(f"model digest {report.digest}")
