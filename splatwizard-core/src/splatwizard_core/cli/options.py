"""Options that several commands share, and how facts are printed."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

from splatwizard_core.cli import complete

if TYPE_CHECKING:
    from rich.console import Console

F = TypeVar("F", bound=Callable[..., Any])


def _not_empty(_context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    if value is not None and not value.strip():
        raise click.UsageError(f"--{parameter.name} is empty: name a file, or leave it out")
    return value


scene_option = click.option(
    "--scene", metavar="SCENE", shell_complete=complete.scenes,
    help="A folder (COLMAP, Blender, ...; the format is detected), `demo`, or `dataset/scene` under "
    "$SPLATWIZARD_DATA.  [default: demo]",
)  # fmt: skip
images_option = click.option(
    "--images", metavar="FOLDER", shell_complete=complete.image_folders,
    help="Picture folder of a COLMAP scene, such as images_2.  [default: the data set's own]",
)  # fmt: skip
method_option = click.option(
    "--method", "-m", metavar="NAME", shell_complete=complete.names("method"),
    help="Method, see `sw list-plugins`.  [default: 3dgs, or what --config says]",
)  # fmt: skip
preset_option = click.option(
    "--preset", metavar="NAME", shell_complete=complete.presets,
    help="Named values of the method.  [default: paper; quick on the demo scene]",
)  # fmt: skip
rate_option = click.option(
    "--rate", metavar="NAME", shell_complete=complete.rates,
    help="Rate point: r1 (smallest file) .. rN, or low, default, high.  [default: default]",
)  # fmt: skip
config_option = click.option(
    "--config", "config_file", type=click.Path(dir_okay=False), metavar="FILE",
    help="TOML file of values; config.toml of a run directory repeats that run.  [default: none]",
)  # fmt: skip
set_option = click.option(
    "--set", "sets", multiple=True, metavar="KEY=VALUE", shell_complete=complete.nothing,
    help="One value, such as iterations=7000 (steps) or resolution=4; repeatable, wins over everything else.",
)  # fmt: skip
init_option = click.option(
    "--init", metavar="FILE.ply", shell_complete=complete.files, callback=_not_empty,
    help="Start from this trained scene, for methods that start from one; for 3dgs its key `init`.  "
    "[default: it is trained first, or taken from an earlier run]",
)  # fmt: skip
device_option = click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]),
    help="Where to compute.  [default: auto, which is CUDA if its kernels can run]",
)  # fmt: skip
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), metavar="N", help="Of every random stream.  [default: 0]"
)
lpips_option = click.option(
    "--lpips-weights", metavar="DIR", shell_complete=complete.folders,
    help="Folder with vgg16-397923af.pth and alexnet-owt-7be5be79.pth, for LPIPS.  [default: torch.hub's cache]",
)  # fmt: skip
repeats_option = click.option(
    "--repeats", type=click.IntRange(min=1), default=1, show_default=True, metavar="N",
    help="Measure rendering speed N times; the spread goes into the record.",
)  # fmt: skip
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object to stdout instead of text.")
debug_option = click.option("--debug", is_flag=True, expose_value=False, help="Show a traceback when something fails.")
resume_option = click.option(
    "--resume/--fresh", default=True, show_default=True,
    help="Go on from the last checkpoint and skip finished steps, or discard what --out holds and start over.",
)  # fmt: skip
changed_plan_option = click.option(
    "--allow-changed-plan", is_flag=True,
    help="Resume although the plan or configuration differs from the checkpoint's; the difference is printed.",
)  # fmt: skip


def options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Several option decorators as one; they appear in `--help` in this order."""

    def apply(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


def assignments(sets: Sequence[str], **named: Any) -> dict[str, Any]:
    """The values of --set together with those that have an option of their own (None: not given)."""
    from splatwizard_core.errors import ConfigError
    from splatwizard_core.runs.config import parse_set

    values: dict[str, Any] = dict(parse_set(sets))
    for key, value in named.items():
        if value is None:
            continue
        if key in values and str(values[key]) != str(value):
            raise ConfigError(f"--{key} {value} contradicts --set {key}={values[key]}: give one of them", key=key)
        values[key] = value
    return values


def print_json(content: Any) -> None:
    """One JSON object on stdout; not-a-number never appears in it."""
    click.echo(json.dumps(content, indent=2, allow_nan=False))


def console() -> Console:
    """Where tables go; plain text if stdout is no terminal."""
    import sys

    from rich.console import Console
    from rich.text import Text

    from splatwizard_core.cli.streams import without_orders

    class Loud(Console):
        """Rich would end the process with status 1 where the reader of a pipe has gone; that is for `main` to say.

        And it would pass on what a file holds, orders to the terminal too.
        """

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(without_orders(text), **options)

    # A pipe has no width: 80 columns would break tables that are meant to be searched.
    return Loud(highlight=False, width=None if sys.stdout.isatty() else 160)
