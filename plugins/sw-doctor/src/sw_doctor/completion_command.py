"""`sw completion`: the script that makes a shell complete commands, options and names."""

from __future__ import annotations

import click

from splatwizard_core.tooling import COMPLETION_VARIABLE, debug_option, options


@click.command(short_help="completion for bash, zsh or fish")
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
