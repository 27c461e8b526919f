"""Options that several commands share, and how facts are printed."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

from splatwizard_core.cli.complete import KEY, PRESET, RATE, SCENE, name_of
from splatwizard_core.cli.paths import OUTPUT_FOLDER
from splatwizard_core.cli.streams import without_orders
from splatwizard_core.plugins.guards import prints_to_stderr
from splatwizard_core.plugins.remedies import as_installed
from splatwizard_native import shortened

if TYPE_CHECKING:
    from rich.console import Console

F = TypeVar("F", bound=Callable[..., Any])

STDOUT = "splatwizard_core.stdout"  # key in a context's `meta`: the stream that `--json` keeps for JSON


def _not_empty(_context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    if value is not None and not value.strip():
        raise click.UsageError(f"--{parameter.name} is empty: name a file, or leave it out")
    return value


def _key(context: click.Context, parameter: click.Parameter, value: str | int | None) -> None:
    """Hand an option that stands for a key of its name to --set."""
    if value is not None:
        context.params["sets"] += (f"{parameter.name}={value}",)


def _seeds(text: str) -> int | tuple[int, ...]:
    first, *more = (click.IntRange(min=0).convert(each, None, None) for each in text.split(","))  # type: ignore[arg-type]
    return (first, *more) if more else first


scene_option = click.option(
    "--scene", metavar="SCENE", type=SCENE,
    help="A folder (the format is detected), `dataset/scene` under $SPLATWIZARD_DATA, or a scene that is made on the "
    "spot, by its name.  [default: such a one; of a file, that of its run directory]",
)  # fmt: skip
images_option = click.option(
    "--images", metavar="FOLDER",
    help="Picture folder of a scene that has several, such as images_2.  [default: the data set's own]",
)  # fmt: skip
method_option = click.option(
    "--method", "-m", "methods", multiple=True, metavar="NAME", type=name_of("method"),
    help="Method, see `sw list-plugins`.  [default: the one marked there, or what --config says]",
)  # fmt: skip
methods_option = click.option(
    "--method", "-m", "methods", multiple=True, metavar="NAME[,NAME]", type=name_of("method"),
    help="One or more methods, see `sw list-plugins`; repeatable.  [default: the one marked there, or what --config "
    "says]",
)  # fmt: skip
preset_option = click.option(
    "--preset", metavar="NAME", type=PRESET,
    help="Named values of the method.  [default: paper; quick on a scene that is made on the spot, or tiny]",
)  # fmt: skip
rate_option = click.option(
    "--rate", metavar="NAME", type=RATE,
    help="Rate point: r1 (smallest file) .. rN, or low, default, high.  [default: default]",
)  # fmt: skip
rates_option = click.option(
    "--rate", metavar="NAME[,NAME]", type=RATE,
    help="Rate points: r1 (smallest file) .. rN, or low, default, high, all.  [default: default]",
)  # fmt: skip
config_option = click.option(
    "--config", "config_file", type=click.Path(dir_okay=False), metavar="FILE",
    help="TOML file of values; config.toml of a run directory repeats that run.  [default: none]",
)  # fmt: skip
set_option = click.option(
    "--set", "sets", multiple=True, metavar="KEY=VALUE", type=KEY, is_eager=True,  # before those that stand for a key
    help="One value, such as iterations=7000 (steps) or resolution=4; repeatable, wins over everything else.",
)  # fmt: skip
init_option = click.option(
    "--init", metavar="FILE.ply", type=click.Path(), callback=_not_empty,
    help="Start from this trained scene, for methods that start from one or have a key `init`.  "
    "[default: it is trained first, or taken from an earlier run]",
)  # fmt: skip
out_option = click.option(
    "--out", default="out", show_default=True, metavar="DIR", type=OUTPUT_FOLDER,
    help="Root of the run directories, DIR/<scene>/<method>/<rate>; a later `sw run` with the same options goes on "
    "there.",
)  # fmt: skip
device_option = click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]),
    help="Where to compute.  [default: auto, which is CUDA if its kernels can run]",
)  # fmt: skip
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), metavar="N", help="Of every random stream.  [default: 0]"
)
seeds_option = click.option(
    "--seed", type=_seeds, metavar="N[,N]", help="Of every random stream; several make a sweep.  [default: 0]"
)
repeats_option = click.option(
    "--repeats", type=click.IntRange(min=1), default=1, show_default=True, metavar="N",
    help="Measure rendering speed N times; the spread goes into the record.",
)  # fmt: skip
geometry_option = click.option("--geometry", is_flag=True, help="Measure geometry too, on scenes that know theirs.")
resume_option = click.option(
    "--resume/--fresh", default=True, show_default=True,
    help="Go on from the last checkpoint and skip finished steps, or discard what --out holds and start over.",
)  # fmt: skip
changed_plan_option = click.option(
    "--allow-changed-plan", is_flag=True,
    help="Resume although the plan or configuration differs from the checkpoint's; the difference is printed.",
)  # fmt: skip


def _json_alone(context: click.Context, _parameter: click.Parameter, asked: bool) -> bool:
    """Until the command ends, let stdout be for `print_json`: whatever else prints does so on stderr."""
    if asked:
        context.meta.setdefault(STDOUT, sys.stdout)
        context.find_root().with_resource(prints_to_stderr())
    return asked


json_option = click.option(
    "--json", "as_json", is_flag=True, callback=_json_alone, help="Print one JSON object to stdout instead of text."
)
debug_option = click.option("--debug", is_flag=True, expose_value=False, help="Show a traceback when something fails.")


def options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Several option decorators as one; they appear in `--help` in this order."""

    def apply(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


size_options = options(  # of a training; a method takes those that are keys of its config
    click.option("--size", metavar="SIZE", expose_value=False, callback=_key,
                 help="Bytes of the file, never more: 5MB.  [default: as --rate says]"),
    click.option("--gaussians", type=click.IntRange(min=1), metavar="N", expose_value=False, callback=_key,
                 help="Gaussians that the training makes at most.  [default: as the method's plan says]"),
)  # fmt: skip


def _size_of_part(context: click.Context, _parameter: click.Parameter, given: str | None) -> int | None:
    from splatwizard_core.base.values import parse_size

    if given is not None and context.params.get("packets") is not None:
        raise click.UsageError("--packets and a size each choose a cut: give one of them")
    return None if given is None else parse_size(given)


def part_options(size: str) -> Sequence[Callable[[F], F]]:
    """Return the options for a part of a file with cuts, parameters packets, size and partial; `size` is called so."""
    return (
        click.option("--packets", type=click.IntRange(min=1), metavar="P", is_eager=True,
                     help="With cuts: the first P packets.  [default: all]"),
        click.option(size, "size", metavar="SIZE", callback=_size_of_part,
                     help="With cuts: the packets that fit, as into 500kB or 2MiB.  [default: all]"),
        click.option("--partial", is_flag=True,
                     help="With cuts: the packets before the place where a file ends early or is damaged."),
    )  # fmt: skip


def say(message: str) -> None:
    """Print a line for the user on stderr: stdout holds results only."""
    click.echo(without_orders(as_installed(shortened(message))), err=True)


def print_json(content: Any) -> None:
    """Print one JSON object on stdout; not-a-number never appears in it."""
    context = click.get_current_context(silent=True)
    stdout = None if context is None else context.meta.get(STDOUT)
    click.echo(json.dumps(content, indent=2, allow_nan=False), file=stdout)


def print_facts(facts: dict[str, Any], as_json: bool, told: str | Callable[[dict[str, Any]], None]) -> None:
    """Print facts on stdout as one JSON object, or as `told` says: a text, or a function that prints them."""
    if as_json:
        print_json(facts)
    elif isinstance(told, str):
        click.echo(told)
    else:
        told(facts)


def console() -> Console:
    """The console for tables on stdout; plain text if that is no terminal. It knows whether it has `printed`."""
    from rich.console import Console
    from rich.text import Text

    class SafeConsole(Console):
        """Leaves a closed pipe to `main`, and passes on no orders to the terminal from what a file holds."""

        printed = False

        def print(self, *objects: Any, **options: Any) -> None:
            self.printed = True
            super().print(*objects, **options)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(without_orders(as_installed(text)), **options)

    # A pipe has no width: 80 columns would break tables that are meant to be searched.
    return SafeConsole(highlight=False, width=None if sys.stdout.isatty() else 160)


def print_table(
    columns: list[str], rows: list[list[str]], *, title: str | None = None, right: int = 0, markup: bool = False
) -> None:
    """Print a table on stdout.

    columns     headings; empty: a table without
    rows        an empty one is a line between sections
    right       columns at the end that are aligned to the right
    markup      cells hold rich's markup; else brackets in them are no markup
    """
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title and escape(title), title_justify="left", show_header=bool(columns))
    width = len(columns or (rows[0] if rows else ()))
    for index, heading in enumerate(columns or [""] * width):
        table.add_column(heading, justify="right" if index >= width - right else "left", overflow="fold")
    for row in rows:
        if row:
            table.add_row(*(row if markup else map(escape, row)))
        else:
            table.add_section()
    console().print(table)
