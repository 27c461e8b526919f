"""Shell completion: what TAB offers, as the shells ask for it, and at what cost."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import click
import pytest
from click.shell_completion import BashComplete

from splatwizard_core.cli import complete
from splatwizard_core.cli.main import cli, command_entries, main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours


def offered(line: str, incomplete: str = "") -> list[str]:
    """What is offered after `sw LINE` for a word that begins with `incomplete`; a type where the shell lists paths."""
    found = BashComplete(cli, {}, "sw", complete.COMPLETION_VARIABLE).get_completions(line.split(), incomplete)
    return [item.value if item.type == "plain" else f"<{item.type}>" for item in found]


@pytest.mark.parametrize(
    ("line", "incomplete", "wanted"),
    [
        ("", "ru", ["run"]),
        ("", "compl", ["completion"]),
        ("run", "--meth", ["--method"]),
        ("data", "syn", ["synth"]),
        ("run --method", "3", ["3dgs"]),
        ("run -m", "3", ["3dgs"]),
        ("schedule", "3d", ["3dgs"]),
        ("run --rate", "r", ["r1", "r2", "r3", "r4", "r5", "r6"]),
        ("run --rate", "r1,r2,r", ["r1,r2,r3", "r1,r2,r4", "r1,r2,r5", "r1,r2,r6"]),
        ("run --rate", "hi", ["high"]),
        ("run --method nobody --rate", "", ["low", "default", "high", "all"]),
        ("run --method 3dgs --preset", "in", ["inria", "inria2024"]),
        ("run --method nobody --preset", "", ["paper", "quick"]),
        ("train --device", "c", ["cpu", "cuda"]),
        ("eval x.swz --metrics", "ssim,l1", ["ssim,l1"]),
        ("data fetch", "dt", ["dtu", "dtu_truth"]),
        ("data list", "db", ["db"]),
        ("data fetch", "dtu/2", ["dtu/24"]),
        ("export a b --format", "pl", ["ply", "ply-as-3dgs"]),
        ("render x.swz --depth", "me", ["median"]),
        ("view", "a", ["<file>"]),
        ("render x.swz --trajectory", "o", ["orbit"]),
        ("decode", "a", ["<file>"]),
        ("run --out", "a", ["<dir>"]),
        ("run --scene", "de", ["<dir>", "demo"]),
        ("info", "de", ["<file>", "demo"]),
        ("completion", "z", ["zsh"]),
        ("bench --method", "3", ["3dgs"]),
        ("bench --executor", "lo", ["local"]),
        ("bench", "plan", ["<file>"]),
        ("run --set", "density.settings.ab", ["density.settings.absgrad="]),
        ("run --method hac,lightgaussian --set", "growth.init", ["growth.init_factor="]),
        ("run --method nobody --set", "see", ["seed="]),
        ("eval x.swz --set", "reso", ["resolution="]),
        ("eval x.swz --set", "densify", []),
    ],
)
def test_names_are_completed(line, incomplete, wanted, monkeypatch):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    assert offered(line, incomplete) == wanted


def test_without_the_command_that_knows_words_none_are_offered_and_no_option_is_explained(monkeypatch, capsys):
    plugins = load_plugins()
    left = {name: entry for name, entry in plugins.commands._entries.items() if not entry.declared.get("completes")}
    assert len(left) + 1 == len(plugins.commands)
    monkeypatch.setattr(plugins.commands, "_entries", left)
    assert offered("run --method", "3") == []
    assert main(["run", "--iterations", "300"]) == 2
    assert "No such option" in capsys.readouterr().err


def test_scenes_below_the_data_folder_are_offered_by_dataset(tmp_path, monkeypatch):
    for name in ("park/tree", "park/bench", "town/square", ".hidden/x"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    assert offered("run --scene") == ["<dir>", "demo", "park/bench", "park/tree", "town/square"]
    assert offered("run --scene", "park/t") == ["<dir>", "park/tree"]
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "nowhere"))
    assert offered("run --scene") == ["<dir>", "demo"]


def test_a_command_that_cannot_be_imported_spoils_no_completion(monkeypatch):
    plugins = load_plugins()
    monkeypatch.setattr(plugins.commands, "_entries", dict(plugins.commands._entries))
    plugins.commands.add("martian", "no_such_module:command", summary="from Mars")
    assert offered("", "mart") == ["martian"]
    assert {"run", "martian"} <= set(offered(""))
    assert offered("", "--h") == ["--help"]


def test_a_restriction_to_a_plugin_that_is_not_there_offers_nothing_and_says_nothing(monkeypatch, capsys):
    for name, value in {
        "SW_PLUGINS": "no-such-plugin", complete.COMPLETION_VARIABLE: "bash_complete",
        "COMP_WORDS": "sw ", "COMP_CWORD": "1",
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    load_plugins.cache_clear()
    try:
        assert main([]) == 2
    finally:
        load_plugins.cache_clear()
    assert capsys.readouterr() == ("", "")


def commands() -> list[tuple[str, click.Command]]:
    found = []
    context = click.Context(cli)
    for name in (entry.name for entry in command_entries() if is_ours(entry.distribution)):
        command = cli.get_command(context, name)
        assert command is not None
        inner = command.commands.items() if isinstance(command, click.Group) else []
        found += [(name, command), *((f"{name} {n}", c) for n, c in inner)]
    return found


def test_every_parameter_that_takes_a_word_offers_something_if_it_can():
    silent = []
    for _, command in commands():
        for parameter in command.params:
            wordless = isinstance(parameter, click.Option) and parameter.is_flag
            by_type = not isinstance(parameter.type, (click.types.StringParamType, click.types.FuncParamType))
            if not wordless and not by_type and parameter._custom_shell_complete is None:
                silent.append(parameter.name)
    # Only the user knows their values.
    known = {"images", "pins", "name", "only", "seed", "given", "size", "quality", "ratio", "split", "views", "frames"}
    assert set(silent) == known


def test_every_option_that_takes_a_value_says_what_holds_without_it():
    silent = []
    for name, command in commands():
        for option in (p for p in command.params if isinstance(p, click.Option)):
            takes_one = not option.is_flag and not option.multiple and not option.required
            if takes_one and not option.show_default and "default" not in (option.help or ""):
                silent.append(f"{name} {option.opts[0]}")
    assert silent == []


def test_what_a_method_declares_for_completion_is_what_it_has():
    for entry in (each for each in load_plugins().methods if is_ours(each.distribution)):
        cls = entry.load()
        assert list(entry.declared["presets"]) == list(cls.PRESETS)
        assert list(entry.declared["rates"]) == list(cls.RATES)


@pytest.mark.parametrize("line", ["run --method ", "run --rate ", "run --scene ", "schedule 3dgs --preset ", ""])
def test_completion_imports_nothing_heavy(line):
    code = f"""
        import os, sys
        words = {f"sw {line}".split()!r}
        os.environ |= {{"_SW_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(words) + " "}}
        os.environ["COMP_CWORD"] = str(len(words))
        from splatwizard_core.cli.main import main
        main([])
        print([m for m in ("torch", "numpy", "scipy", "pydantic", "PIL", "rich") if m in sys.modules], file=sys.stderr)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, "SW_PLUGINS": ",".join(p.key for p in load_plugins().plugins if is_ours(p.distribution))},
    )  # fmt: skip
    assert done.stderr == "[]\n"
    assert done.stdout.startswith(("plain,", "dir,"))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_each_shell_asks_sw(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert f"{complete.COMPLETION_VARIABLE}={shell}_complete" in script
    if shutil.which(shell):
        done = subprocess.run([shell, "-n"], input=script, capture_output=True, text=True, timeout=300, check=False)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_a_line(tmp_path):
    """As at a prompt: the function that the script defines fills COMPREPLY."""
    sw = tmp_path / "sw"
    sw.write_text(f'#!/bin/sh\nexec {sys.executable} -m splatwizard_core "$@"\n')
    sw.chmod(0o755)
    lines = f"""
        eval "$(sw completion bash)"
        COMP_WORDS=(sw run --method 3d); COMP_CWORD=3
        {BashComplete(cli, {}, "sw", complete.COMPLETION_VARIABLE).func_name} sw
        echo "got ${{COMPREPLY[*]}}"
    """
    done = subprocess.run(
        ["bash", "--norc", "-c", textwrap.dedent(lines)], capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}, cwd=Path(tmp_path),
    )  # fmt: skip
    assert done.stdout == "got 3dgs\n", done.stderr
