"""Write docs/cli.md from `--help`, with every package of ours installed: `python tools/cli_docs.py docs/cli.md`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import click

from splatwizard_core.cli.main import cli, command_entries
from splatwizard_core.plugins.catalogue import is_ours

WIDTH = 100

INTRODUCTION = """\
# The command `sw`

This page is generated from `--help` (`make docs`); a test holds the two together. It has the commands of all packages
of this project; `sw --help` lists those that are installed, other people's among them.

Exit status: 0 done, 1 failure, 2 wrong input, 130 interrupted. Errors are one or two lines on stderr; `--debug` adds a
traceback. Results go to stdout, progress and messages to stderr; with `--json` stdout is one JSON object.
"""


def pages(command: click.Command, name: str, parent: click.Context | None) -> Iterator[tuple[str, str]]:
    """(`sw run`, its help) for a command and, if it is a group, for those in it; strangers' commands are left out."""
    context = click.Context(
        command,
        info_name=name,
        parent=parent,
        terminal_width=WIDTH,
        max_content_width=WIDTH,
        help_option_names=cli.context_settings["help_option_names"],
    )
    if command is cli:
        # The list of commands would contain what strangers have installed.
        formatter = context.make_formatter()
        command.format_usage(context, formatter)
        command.format_help_text(context, formatter)
        yield context.command_path, formatter.getvalue().rstrip()
        names = [entry.name for entry in command_entries() if is_ours(entry.distribution)]
    else:
        yield context.command_path, command.get_help(context)
        names = command.list_commands(context) if isinstance(command, click.Group) else []
    for inner in names:
        assert isinstance(command, click.Group)
        found = command.get_command(context, inner)
        assert found is not None
        yield from pages(found, inner, context)


def generate() -> str:
    """The whole page."""
    blocks = [INTRODUCTION]
    for title, text in pages(cli, "sw", None):
        body = "\n".join(line.rstrip() for line in text.splitlines())
        blocks.append(f"## {title}\n\n```text\n{body}\n```\n")
    return "\n".join(blocks)


def main() -> int:
    """Write the page to the file that is named, or to stdout."""
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(generate(), encoding="utf-8")
    else:
        sys.stdout.write(generate())
    return 0


if __name__ == "__main__":
    sys.exit(main())
