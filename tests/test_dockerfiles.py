"""The Dockerfiles: linted by hadolint where it is, and by rules of their own everywhere."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest
from import_graph import ROOT

FILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
INSTRUCTIONS = {"FROM", "RUN", "WORKDIR", "COPY", "ARG", "ENV", "USER", "ENTRYPOINT", "CMD"}


def instructions(text: str) -> list[tuple[str, str]]:
    """(instruction, arguments), continued lines joined."""
    joined = re.sub(r"\\\n\s*", " ", "".join(line for line in text.splitlines(True) if not line.startswith("#")))
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in joined.splitlines() if line.strip())]


def test_there_is_one_for_each_device():
    assert [path.name for path in FILES] == ["cpu.Dockerfile", "cuda.Dockerfile"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_dockerfile_is_well_formed(path):
    found = instructions(path.read_text("utf-8"))
    words = [word for word, _ in found]
    assert set(words) <= INSTRUCTIONS
    assert words[0] == "FROM"
    assert re.fullmatch(r"\S+:[\w.-]*\d[\w.-]*", found[0][1]), "the base image has a pinned tag"
    assert all(rest.strip() for _, rest in found)
    for _, rest in (each for each in found if each[0] == "RUN"):
        assert "sudo" not in rest
        if "apt-get install" in rest:
            assert "--no-install-recommends" in rest
            assert "rm -rf /var/lib/apt/lists" in rest
    assert words.index("USER") < words.index("ENTRYPOINT"), "nothing runs as root"
    for word, rest in found:
        if word in ("ENTRYPOINT", "CMD"):
            assert re.fullmatch(r'\[("[^"]+"(, )?)+\]', rest), "the form without a shell passes signals on"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_what_a_dockerfile_makes_is_a_target_of_the_makefile(path):
    (made,) = re.findall(r"make VENV=(\S+) (\S+)", path.read_text("utf-8"))
    dry = subprocess.run(
        ["make", "-n", f"VENV={made[0]}", made[1]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert dry.returncode == 0, dry.stderr


@pytest.mark.skipif(shutil.which("hadolint") is None, reason="hadolint is not here")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_hadolint_finds_nothing(path):
    # DL3008: versions of Debian's packages follow the base image, which is pinned.
    done = subprocess.run(["hadolint", "--ignore", "DL3008", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
