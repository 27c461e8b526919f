"""The command `sw`: finds its subcommands lazily and turns errors into one line and an exit status."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from splatwizard_core.cli.complete import COMPLETION_VARIABLE, completing_command
from splatwizard_core.cli.streams import abandon_streams, ended_like_ctrl_c, open_streams, without_orders
from splatwizard_core.errors import FULL, DiskFullError, PluginError, TaskError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.origins import Origins
from splatwizard_core.plugins.registry import nearest
from splatwizard_core.plugins.remedies import as_installed
from splatwizard_core.plugins.strangers_code import exits_are_raised
from splatwizard_native import ForeseenError, shortened

if TYPE_CHECKING:
    from splatwizard_core.plugins import Entry

# A path that somebody gave does not fit what is on the disk; a full disk is another matter.
PATH_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
SIGPIPE_STATUS = 141  # what a shell reports of a program whose reader has gone


class LazyGroup(click.Group):
    """A group whose commands come from the registry and are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [entry.name for entry in command_entries()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        commands = load_plugins().commands
        known = cmd_name in commands or cmd_name in commands.clashes
        return commands.load(cmd_name) if known else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """One line a command, from the registry: `sw --help` imports none of them."""
        with formatter.section("Commands"):
            formatter.write_dl([(entry.name, entry.summary) for entry in command_entries()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands from the registry: TAB imports none of them, and so suffers from no stranger's."""
        options = click.Command.shell_complete(self, ctx, incomplete)
        return options + [
            CompletionItem(e.name, help=e.summary) for e in command_entries() if e.name.startswith(incomplete)
        ]

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        with _ended_by_reader():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a reader that goes away (`sw info x | head`) ends it quietly."""
        with _ended_by_reader():
            result = super().invoke(ctx)
            sys.stdout.flush()
        return result

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        words = "\0".join(args).replace("=", "\0").split("\0")
        for option, number, unit in zip(words, words[1:], words[2:], strict=False):
            if option in ("--size", "--bytes") and number[-1:].isdigit() and unit[1:].lower() in ("b", "ib"):
                raise click.UsageError(f"{option} {number} {unit} has a blank in it: write {number}{unit}", ctx)
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            hint = nearest("command", args[0], self.list_commands(ctx))
            raise click.UsageError(f"no command '{args[0]}': {hint}", ctx) from error


def command_entries() -> list[Entry]:
    """The commands in the order of the help: those with a declared `position` by it, then by name."""
    return sorted(load_plugins().commands, key=lambda e: (e.declared.get("position", math.inf), e.name))


@contextlib.contextmanager
def _ended_by_reader() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        abandon_streams()
        raise click.exceptions.Exit(SIGPIPE_STATUS) from None


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="splatwizard-core", message="%(version)s", help="Print the version.")
@click.option("--debug", is_flag=True, expose_value=False, help="Show a traceback when something fails (any command).")
def cli() -> None:
    """Splatwizard: train, compress, decode and measure 3D Gaussian Splatting scenes, any method, one protocol.

    Methods, rasterizers and codecs come from installed plugins: see `sw list-plugins`.
    """


class _AsInstalled(logging.Formatter):
    """Messages whose advice to install something works here."""

    def format(self, record: logging.LogRecord) -> str:
        return as_installed(super().format(record))


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sw` and return its exit status: 0, 2 wrong input, 1 failure, 130 interrupted."""
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    handler, debug = logging.StreamHandler(), "--debug" in arguments
    handler.setFormatter(_AsInstalled("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, handlers=[handler])
    for noisy in ("PIL", "torch", "matplotlib"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    with ended_like_ctrl_c(), exits_are_raised():
        try:
            status = cli.main(args=arguments, prog_name="sw", standalone_mode=False)
        except BaseException as error:
            return _report(error, arguments, debug=debug)
    return status if isinstance(status, int) else 0


def _report(error: BaseException, arguments: Sequence[str], *, debug: bool) -> int:
    """One or two lines on stderr, and the exit status that the error leads to."""
    if COMPLETION_VARIABLE in os.environ and isinstance(error, ForeseenError):
        return error.exit_status  # the shell asks for completions: TAB is not the place to say what is wrong
    culprit = _culprit(error, arguments)
    if isinstance(error, SystemExit) and culprit:
        _say(f"error: {type(error).__name__}: {error}{culprit}")
        return 1
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    if debug and not isinstance(error, (click.ClickException, click.Abort)):
        traceback.print_exception(error)
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        how = f" (the same command{' without --fresh' if '--fresh' in arguments else ''} resumes a run)"
        _say("interrupted" + how * bool({"run", "train"} & {*arguments[:2]}))
        return 130
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        _say(error.format_message())
        return error.exit_code
    if isinstance(error, click.NoSuchOption):
        command = completing_command()
        if command is not None and (hint := command.hint(error, arguments)) is not None:
            _say(f"error: {hint}")
            return error.exit_code
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        hint = f" (`{context.command_path} --help`)" if context is not None and context.command_path != "sw" else ""
        _say(f"error: {error.format_message()}{hint}")
        return error.exit_code
    if isinstance(error, OSError) and error.errno in FULL:
        # What did not go through our own writing may not say where.
        error = DiskFullError(str(error.filename or "a file"), FULL[error.errno])
    if isinstance(error, ForeseenError):
        _say(f"error: {error}{culprit if isinstance(error, TaskError) else ''}")
        return error.exit_status
    add_debug = culprit + ("" if debug else " (a traceback: add --debug)")
    if isinstance(error, OSError) and error.strerror is not None:
        at = "" if error.filename is None else f"{error.filename}: "
        _say(f"error: {at}{error.strerror}{add_debug}")
    elif not debug:
        _say(f"error: {type(error).__name__}: {' '.join(str(error).split()):.500}{add_debug}")
    return 2 if isinstance(error, PATH_ERRORS) else 1


def _culprit(error: BaseException, arguments: Sequence[str]) -> str:
    """` (in sw-theirs 0.2)` for what came up in a stranger's package; nothing where its own command exits."""
    try:
        plugins = load_plugins()
        distribution, version = Origins(plugins).culprit(error)
        command = next((word for word in arguments if not word.startswith("-")), "")
        exits = isinstance(error, SystemExit) and plugins.commands.entry(command).distribution == distribution
    except PluginError:  # SW_PLUGINS is what is wrong
        return ""
    return f" (in {distribution} {version})" if distribution and not exits else ""


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # nobody reads it: the exit status must do
        print(without_orders(as_installed(shortened(text))), file=sys.stderr, flush=True)
