"""`sw completion`: the script that makes a shell complete commands, options and names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import COMPLETION_VARIABLE, debug_option, options

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class Completion(click.Command):
    """The command, which the core also asks for the words of parameters and about options that a command lacks."""

    def items(self, word: Any, context: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return what TAB offers for a parameter of the type `Word`."""
        from sw_doctor.words import items

        return items(word.kind, word.paths, context, incomplete)

    def hint(self, error: click.NoSuchOption, arguments: Sequence[str]) -> str | None:
        """Return what to give in place of an option that there is not; None: no key is called so."""
        from sw_doctor.unknown_option import set_hint

        return set_hint(error, arguments)


@click.command(cls=Completion, short_help="completion for bash, zsh or fish")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@options(debug_option)
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script that lets SHELL complete commands, options, methods, rate points, presets and scenes.

    \b
    bash   echo 'eval "$(sw completion bash)"' >> ~/.bashrc
    zsh    echo 'eval "$(sw completion zsh)"' >> ~/.zshrc     (after compinit)
    fish   sw completion fish > ~/.config/fish/completions/sw.fish
    """
    from click.shell_completion import get_completion_class

    found = get_completion_class(shell)
    assert found is not None  # click knows all three
    click.echo(found(context.find_root().command, {}, "sw", COMPLETION_VARIABLE).source(), nl=False)
