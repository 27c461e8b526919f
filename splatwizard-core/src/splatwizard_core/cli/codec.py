"""`sw encode` and `sw decode`: a trained model to one file, and a file back to a model."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.base.progress import counted, several
from splatwizard_core.cli import options as shared
from splatwizard_core.cli.paths import EXISTING, INPUT_FILE, OUTPUT_FILE, existing, output_file
from splatwizard_core.cli.setup import Choices, open_session, takes_choices
from splatwizard_core.plugins import load_plugins


@click.command(short_help="a trained model to one file")
@click.argument("source", metavar="SOURCE", type=EXISTING)
@shared.options(
    click.option(
        "--out", metavar="FILE", type=OUTPUT_FILE,
        help="The file to write.  [default: scene.swz beside SOURCE]",
    ),
    shared.method_option, shared.rate_option, shared.preset_option, shared.config_option, shared.set_option,
    click.option("--no-psnr", is_flag=True, help="Of a run directory: do not measure the file on the test views."),
    shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def encode(source: Path, out: Path | None, no_psnr: bool, as_json: bool, chosen: Choices) -> None:
    """Encode SOURCE into one .swz file; tell how much smaller it is, and its PSNR.

    SOURCE is a run directory whose training is finished (its config.toml holds; --rate and --set change values of the
    codec), or a .ply of explicit Gaussians, for methods that encode such. The PSNR is that of a run directory's scene.
    """
    from splatwizard_core.runs.encode import encode_directory, encode_ply
    from splatwizard_core.runs.measure import measure, opener

    plugins, is_run = load_plugins(), source.is_dir()
    target = out or output_file((source if is_run else source.parent) / "scene.swz")
    if is_run and chosen.config_file is None:
        existing(source / "config.toml", ": `sw train` makes the folder of a run, which has one")
        chosen = chosen.with_rate_of(source, plugins)
    resolved = chosen.resolve_one(plugins)
    session = open_session(resolved, plugins)
    done = (encode_directory if is_run else encode_ply)(session, resolved, source, target)
    facts = done.model_dump(mode="json")
    of = "its parameters as float32" if is_run else source.name
    facts["ratio"] = (facts["float32_bytes"] if is_run else source.stat().st_size) / facts["bytes"]
    ratio = facts["ratio"]
    told = f"{facts['bytes']:,} bytes, {max(ratio, 1 / ratio):.1f} x {'smaller' if ratio >= 1 else 'larger'} than {of}"
    if is_run and not no_psnr:
        measured = measure(session, resolved, opener(target, session), metrics=["psnr"], speed=False)
        facts["psnr"] = psnr = measured.metrics["psnr"].mean
        told += "" if psnr is None else f", PSNR {psnr:.2f} dB on {len(measured.views)} test views"
    told += f", in {facts['encode_s']:.2f} s: {target}"
    shared.print_facts({"file": str(target), **facts}, as_json, told)


@click.command(short_help="a file back to a model, from nothing but itself")
@click.argument("file", metavar="FILE.swz", type=INPUT_FILE)
@shared.options(
    click.option(
        "--out", metavar="FILE", type=OUTPUT_FILE,
        help="Where to put the decoded model: .safetensors holds its tensors, other suffixes go to an exporter (.ply). "
        " [default: it is not kept]",
    ),
    click.option(
        "--repeats", type=click.IntRange(min=0), default=3, show_default=True, metavar="N",
        help="Timed decodes after the first one; their median is reported.",
    ),
    click.option("--hash", "hash_only", is_flag=True, help="Print nothing but SHA-256 of the decoded parameters."),
    *shared.part_options("--bytes"),
    shared.set_option, shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def decode(
    file: Path, out: Path | None, repeats: int, hash_only: bool, packets: int | None, size: int | None, partial: bool,
    as_json: bool, chosen: Choices,
) -> None:  # fmt: skip
    """Decode FILE.swz from nothing but itself; report time, counts and the digest of the model."""
    from splatwizard_core.coding.container import ContainerReader
    from splatwizard_core.coding.cuts import Prefix
    from splatwizard_core.runs.decode import decode_model, save_decoded, timed_decode

    plugins = load_plugins()
    prefix = Prefix(packets, size, partial)
    if hash_only and (out is not None or as_json):
        raise click.UsageError("--hash prints nothing but the hash: leave out --out and --json")
    if hash_only:
        click.echo(decode_model(ContainerReader.open(file, prefix), plugins).parameter_hash())
        return
    session = open_session(chosen.resolve_without_method(), plugins)
    model, facts = timed_decode(file, session, repeats=repeats, prefix=prefix)
    if out is not None:
        save_decoded(model, facts, out, plugins)
    printed = facts.model_dump(mode="json") | ({} if out is None else {"out": str(out)})
    part = f"{several(facts.packets, 'packet')}, {facts.bytes:,} bytes, " if facts.packets else ""
    told = f"{part}{counted(facts.counts)}, decoded in {facts.decode_s:.3f} s on {facts.device}"
    shared.print_facts(printed, as_json, f"{facts.method}: {told}\nmodel digest {facts.digest}")
