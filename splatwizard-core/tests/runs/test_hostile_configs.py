"""Configuration files of strangers: refused in one short line, at once."""

from __future__ import annotations

import time

import pytest

from splatwizard_core.cli.main import main
from splatwizard_core.errors import ConfigError
from splatwizard_core.runs.config import read_config_file


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = " + "[" * 100_000, "nested too deeply"),
        ("x = " + "{a = " * 50_000, "nested too deeply|not valid TOML"),
        ("a." * 50_000 + "b = 1", "line 1: a key of more than 50 parts"),
        ("# a comment\n[" + "a." * 50_000 + "b]", "line 2: a key of more than 50 parts"),
        ("x = {" + "a . " * 50_000 + "b = 1}", "a key of more than 50 parts"),
        ("x" * 2_000_000, "more than 1,048,576 bytes"),
        ("x = '" + "y" * 1_000_000 + "'\n" + "z" * 10_000, "not valid TOML"),
    ],
)
def test_a_hostile_file_is_refused_at_once(tmp_path, text, told):
    path = tmp_path / "c.toml"
    path.write_text(text)
    began = time.perf_counter()
    with pytest.raises(ConfigError, match=told):
        read_config_file(path)
    assert time.perf_counter() - began < 5


def test_numbers_of_a_path_are_no_deep_key(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("seed = 3\nscene = '" + "/a.b" * 40 + "'\n")
    assert read_config_file(path)["seed"] == 3


def test_a_key_of_60000_letters_is_not_repeated_whole(capsys):
    assert main(["info", "demo:tiny", "--set", f"{'k' * 60_000}=1"]) == 2
    assert len(capsys.readouterr().err) < 3000
