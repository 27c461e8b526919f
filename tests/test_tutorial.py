"""docs/tutorial.md, line by line: from `sw new-plugin` to a wheel.

Nothing is changed but that trainings are short and of the small demo scene, and that pip, in an environment of its own,
takes what is there instead of asking a network. Everything else runs in processes that have what pip installed on
their path, beside this workspace.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from fresh_environments import ROOT, FreshEnvironment, make_environment
from strangers_site import Site

PAGE = ROOT / "docs" / "tutorial.md"
SHORT = ["--set", "iterations=20"]
STARTED = ["--set", "pretrained.iterations=20"]
OFFLINE = ["--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check", "-q"]
PYTEST = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"
STEP = re.compile(r"((?:^    [^\n]+\n)+)|^```python\n# (file|replace in): (\S+)\n(.*?)^```$", re.M | re.S)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> FreshEnvironment:
    return make_environment(tmp_path_factory.mktemp("tutorial") / "env")


class Reader:
    """Somebody who does what the page says, in a folder of their own."""

    def __init__(self, environment: FreshEnvironment, folder: Path) -> None:
        self.environment, self.folder = environment, folder
        self.site = Site(folder / "site")
        self.site.folder.mkdir()
        self.done: list[str] = []

    def paste(self, line: str) -> None:
        """Run a line of a shell."""
        self.done.append(line)
        program, *words = shlex.split(line)
        if program == "cd":
            self.folder /= words[0]
            return
        if program == "sw" and words[0] == "run":
            words = [word if word != "demo" else "demo:tiny" for word in words]
            words += SHORT if "3dgs" in words else [*SHORT, *STARTED]
        done = getattr(self, program)(*words)
        assert done.returncode == 0, (
            f"`{line}` ended with {done.returncode}:\n{done.stdout[-2500:]}{done.stderr[-800:]}"
        )

    def sw(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self.site.run("-m", "splatwizard_core", *words, cwd=self.folder)

    def pytest(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self.site.run("-c", PYTEST, "-p", "no:cacheprovider", "--import-mode=importlib", *words, cwd=self.folder)

    def ruff(self, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "ruff", *words, "--no-cache"]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)

    def pip(self, *words: str) -> subprocess.CompletedProcess[str]:
        """What it installs is put on the path: metadata, and the folders that a .pth names."""
        command = [str(self.environment.python), "-m", "pip", *words, *OFFLINE]
        surroundings = {**self.environment._surroundings({}), "cwd": self.folder}
        done = subprocess.run(command, **surroundings, capture_output=True, timeout=1200, check=False)
        (installed,) = self.environment.prefix.glob("lib/python*/site-packages")
        for information in installed.glob("sw_area_prune-*.dist-info"):
            place = self.site.folder / information.name
            place.exists() or place.symlink_to(information)
        for named in installed.glob("*area_prune*.pth"):
            for module in Path(named.read_text().strip()).iterdir():
                place = self.site.folder / module.name
                place.exists() or place.symlink_to(module)
        return done

    def save(self, path: str, text: str) -> None:
        """Write a file of the package, which has one already."""
        assert (self.folder / path).is_file(), f"the tutorial changes {path}, which is not there"
        (self.folder / path).write_text(text)

    def replace(self, path: str, text: str) -> None:
        """Replace what stands before the line `# by` with what stands after it."""
        before, after = text.strip().split("\n# by\n")
        old = (self.folder / path).read_text()
        assert old.count(before) == 1, f"'{before}' is not in {path} once"
        (self.folder / path).write_text(old.replace(before, after))


@pytest.mark.pipeline
def test_the_tutorial_leads_to_a_wheel(environment: FreshEnvironment, tmp_path: Path) -> None:
    reader = Reader(environment, tmp_path)
    for commands, kind, path, text in STEP.findall(PAGE.read_text("utf-8")):
        for line in commands.splitlines():
            reader.paste(line.strip())
        if kind:
            (reader.save if kind == "file" else reader.replace)(path, text)
    assert len(reader.done) >= 12
    package = tmp_path / "sw-area-prune"
    assert len(list((package / "dist").glob("sw_area_prune-*.whl"))) == 1
    runs = package / "out" / "demo-tiny"
    found = sorted(str(path.parent.relative_to(runs)) for path in runs.glob("*/*/metrics.json"))
    assert found == ["3dgs/r3", "area-prune/r1", "area-prune/r2", "area-prune/r3"]
