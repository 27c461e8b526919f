"""A TOML file from a stranger is refused before a parser spends time on it, or it is read as ever."""

import os

import pytest

from splatwizard_core.base import toml_file
from splatwizard_core.base.toml_file import MAX_BYTES, MAX_PARTS, read_toml
from splatwizard_core.errors import ConfigError

QUOTED = '"\\"".' * 40_000

HOSTILE = {
    "brackets": (b"x = " + b"[" * 100_000, "its brackets are nested too deeply"),
    "tables in tables": (b"x = " + b"{a=" * 100_000, "its brackets are nested too deeply"),
    "a dotted key": (b"\n\n" + b"a." * 50_000 + b"a = 1", "line 3 has a key of more than 32 parts"),
    "a dotted table": (b"[" + b" a ." * 50_000 + b"a]", "line 1 has a key"),
    "a dotted key in a table in line": (b"x = {" + b"a . " * 50_000 + b"b = 1}", "line 1 has a key"),
    "a dotted key of quotes": (QUOTED.encode() + b"a = 1", "line 1 has a key"),
    "a dotted key of apostrophes": (b"'.'." * 50_000 + b"a = 1", "line 1 has a key"),
    "a file without an end": (b"#" * (MAX_BYTES + 1), "1,048,576 bytes are the most"),
    "an integer of many digits": (b"x = 1" + b"0" * 6000, "is not valid TOML"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_in_one_line(name, tmp_path, monkeypatch):
    if "dotted" in name:
        monkeypatch.setattr(toml_file.tomllib, "loads", None)  # no parser sees it
    content, told = HOSTILE[name]
    (tmp_path / "x.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=told) as caught:
        read_toml(tmp_path / "x.toml", "--config")
    assert len(str(caught.value)) < 300 + len(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_unclosed_quotes_are_looked_at_once(tmp_path):
    """Each of them begins a text; without a bound on it all would be followed to the end of the line."""
    assert "{0,200}" in toml_file._NAME.pattern
    (tmp_path / "x.toml").write_bytes(b'x = "' + b'\\"' * 40_000)
    with pytest.raises(ConfigError, match="is not valid TOML"):
        read_toml(tmp_path / "x.toml", "--config")


def test_a_pipe_in_a_folder_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "config.toml")
    with pytest.raises(ConfigError, match="it is a pipe"):
        read_toml(tmp_path / "config.toml", "--config")


def test_a_pipe_of_the_shell_is_read():
    ours, theirs = os.pipe()
    os.write(theirs, b"iterations = 3")
    os.close(theirs)
    try:
        assert read_toml(f"/dev/fd/{ours}", "--config") == ({"iterations": 3}, "iterations = 3")
    finally:
        os.close(ours)


def test_what_people_write_is_read(tmp_path):
    key = ".".join(["a"] * MAX_PARTS)
    text = f"""
{key} = {"[" * 50}1{"]" * 50}
scene = '{"/a.b" * 40}'
more."quoted.key".x = "a.b.c, {"you see. " * 200}"
# {"-." * 100}
version = "{".".join("12345678901234567890")}{".1" * 20}"
"""
    (tmp_path / "x.toml").write_text(text)
    tables, same = read_toml(tmp_path / "x.toml", "--config")
    assert same == text
    assert set(tables) == {"a", "scene", "more", "version"}
