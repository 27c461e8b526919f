"""The command `sw`: finds its subcommands lazily and turns errors into one line and an exit status."""

from __future__ import annotations

import contextlib
import importlib
import logging
import sys
import traceback
from collections.abc import Iterator, Sequence
from typing import Any

import click

from splatwizard_core.cli.streams import abandon_streams, ended_like_ctrl_c, open_streams, without_orders
from splatwizard_core.errors import DiskFullError, PluginError, SplatwizardError
from splatwizard_core.files import FULL

COMMANDS = {
    "run": "splatwizard_core.cli.run:run",
    "train": "splatwizard_core.cli.train:train",
    "encode": "splatwizard_core.cli.codec:encode",
    "decode": "splatwizard_core.cli.codec:decode",
    "eval": "splatwizard_core.cli.evaluate:evaluate",
    "render": "splatwizard_core.cli.render:render",
    "report": "splatwizard_core.cli.report:report",
    "export": "splatwizard_core.cli.export:export",
    "info": "splatwizard_core.cli.info:info",
    "list-plugins": "splatwizard_core.cli.list_plugins:list_plugins",
    "schedule": "splatwizard_core.cli.schedule:schedule",
    "data": "splatwizard_core.cli.data:data",
    "build-kernels": "splatwizard_core.cli.build_kernels:build_kernels",
    "doctor": "splatwizard_core.cli.doctor:doctor",
    "completion": "splatwizard_core.cli.completion:completion",
}
# A path that somebody gave does not fit what is on the disk; a full disk is another matter.
PATH_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
SIGPIPE_STATUS = 141  # what a shell reports of a program whose reader has gone


class LazyGroup(click.Group):
    """A group whose own commands are imported when asked for; plugins add theirs through `register_commands`."""

    _plugins_asked = False

    def list_commands(self, ctx: click.Context) -> list[str]:
        self.ask_plugins()
        return [*COMMANDS, *sorted(self.commands)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        target = COMMANDS.get(cmd_name)
        if target is not None:
            module, _, attribute = target.partition(":")
            command: click.Command = getattr(importlib.import_module(module), attribute)
            return command
        self.ask_plugins()
        return super().get_command(ctx, cmd_name)

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Called by plugins. Raises PluginError for a name that is taken."""
        taken = name or cmd.name
        if taken in COMMANDS or taken in self.commands:
            raise PluginError(f"command '{taken}' already exists")
        super().add_command(cmd, name)

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        with _quiet_about_readers():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a reader that goes away (`sw info x | head`) ends it quietly."""
        with _quiet_about_readers():
            result = super().invoke(ctx)
            sys.stdout.flush()
        return result

    def ask_plugins(self) -> None:
        """Let every plugin add its commands, once."""
        if not self._plugins_asked:
            from splatwizard_core.plugins import load_plugins

            self._plugins_asked = True
            load_plugins().register_commands(self)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        import difflib

        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), n=1)
            hint = f"did you mean '{near[0]}'?" if near else "`sw --help` lists all"
            raise click.UsageError(f"no command '{args[0]}': {hint}", ctx) from error


@contextlib.contextmanager
def _quiet_about_readers() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        abandon_streams()
        raise click.exceptions.Exit(SIGPIPE_STATUS) from None


def _version(ctx: click.Context, _param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        import importlib.metadata

        click.echo(importlib.metadata.version("splatwizard-core"))
        ctx.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Print the version."
)
@click.option("--debug", is_flag=True, expose_value=False, help="Show a traceback when something fails (any command).")
def cli() -> None:
    """Splatwizard: train, compress, decode and measure 3D Gaussian Splatting scenes, any method, one protocol.

    Methods, rasterizers and codecs come from installed plugins: see `sw list-plugins`.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sw` and return its exit status: 0, 2 wrong input, 1 failure, 130 interrupted."""
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, format="%(levelname)s: %(message)s")
    for noisy in ("PIL", "torch", "matplotlib"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    with ended_like_ctrl_c():
        try:
            status = cli.main(args=arguments, prog_name="sw", standalone_mode=False)
        except BaseException as error:
            return _report(error, debug=debug, fresh="--fresh" in arguments)
    return status if isinstance(status, int) else 0


def _report(error: BaseException, *, debug: bool, fresh: bool) -> int:
    """One or two lines on stderr, and the exit status that the error leads to."""
    if debug and not isinstance(error, (click.ClickException, click.Abort, SystemExit)):
        traceback.print_exception(error)
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        _say(f"interrupted (the same command{' without --fresh' if fresh else ''} resumes a run)")
        return 130
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        _say(error.format_message())
        return error.exit_code
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        hint = f" (`{context.command_path} --help`)" if context is not None and context.command_path != "sw" else ""
        _say(f"error: {error.format_message()}{hint}")
        return error.exit_code
    if isinstance(error, SplatwizardError):
        _say(f"error: {error}")
        return error.exit_status
    if isinstance(error, OSError) and error.strerror is not None:
        if error.errno in FULL:
            # What did not go through our own writing may not say where.
            _say(f"error: {DiskFullError(str(error.filename or 'a file'), FULL[error.errno])}")
            return DiskFullError.exit_status
        at = "" if error.filename is None else f"{error.filename}: "
        _say(f"error: {at}{error.strerror}{'' if debug else ' (a traceback: add --debug)'}")
        return 2 if isinstance(error, PATH_ERRORS) else 1
    if not debug:
        text = " ".join(str(error).split())
        _say(f"error: {type(error).__name__}: {text:.500} (a traceback: add --debug)")
    return 1


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # nobody reads it: the exit status must do
        print(without_orders(text), file=sys.stderr, flush=True)
