"""`sw export`: a decoded scene in an interchange format."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.api import GaussianModel, SplatModel, UserInputError
from splatwizard_core.tooling import (
    INPUT_FILE,
    OUTPUT_FILE,
    Choices,
    debug_option,
    device_option,
    json_option,
    name_of,
    options,
    print_facts,
    takes_choices,
)


@click.command(short_help=".ply and other interchange formats")
@click.argument("file", metavar="FILE", type=INPUT_FILE)
@click.argument("out", metavar="OUT", type=OUTPUT_FILE)
@options(
    click.option(
        "--format", "exporter", metavar="NAME", type=name_of("exporter"),
        help="Exporter, see `sw list-plugins`.  [default: by the suffix of OUT]",
    ),
    click.option(
        "--world", is_flag=True,
        help="Write coordinates of the world that the scene's files are in, where the scene was moved to a local "
        "origin: as doubles in a .ply.",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def export(file: Path, out: Path, exporter: str | None, world: bool, as_json: bool, chosen: Choices) -> None:
    """Decode FILE (.swz, .ply or another format) and write it to OUT in the format of its suffix, such as .ply."""
    from splatwizard_core.tooling import bytes_with_named, export_model, load_plugins, open_session, opener

    if out.exists() and out.samefile(file):
        raise UserInputError(f"{out} is the file that is read: give OUT another name")
    plugins = load_plugins()
    session = open_session(chosen.resolve_without_method(), plugins)
    model = opener(file, session)().model
    if world:
        model = in_world(model, file.name)
    name = export_model(model, out, plugins, exporter)
    facts = {"file": str(out), "format": name, "bytes": bytes_with_named(out), "counts": model.counts()}
    print_facts(facts, as_json, f"{facts['bytes']:,} bytes ({name}): {out}")


def in_world(model: SplatModel, name: str) -> SplatModel:
    """The model, asked of the next exporter in the coordinates of the world: `GaussianModel.world_shift` is its origin.

    An exporter that can hold doubles adds it in double precision, others do in float32.
    Raises UserInputError for what is no explicit Gaussians, and where the file does not say where its origin lies.
    """
    if not isinstance(model, GaussianModel):
        raise UserInputError(
            f"--world: {name} holds no explicit Gaussians, its own depend on the camera; "
            "`sw bake FILE OUT --scene SCENE` fits explicit ones, which keep the origin of the scene"
        )
    if model.world_origin is None:
        raise UserInputError(
            f"--world: {name} does not say where its origin lies: its scene was not moved, or another program wrote it"
        )
    model.origin = {**model.origin, "as_world": True}
    return model
