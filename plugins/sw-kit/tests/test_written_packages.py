"""Packages that `sw new-plugin` writes work: their tests pass, they are listed, and they pass `sw check-plugin`."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
from forked_children import run_python

_spec = importlib.util.spec_from_file_location("kit_packages", Path(__file__).parent / "kit_packages.py")
assert _spec is not None
assert _spec.loader is not None
packages = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(packages)


PYTEST = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return packages.one_of_each(tmp_path_factory.mktemp("written"))


def run(written, *command, cwd):
    return run_python(*command, cwd=cwd, env=packages.environment(written.values()))


def check(written, kinds, cwd, *options):
    """Findings of `sw check-plugin` on the packages of these kinds."""
    names = [written[kind].name for kind in kinds]
    done = run(written, "-m", "splatwizard_core", "check-plugin", *names, "--json", *options, cwd=cwd)
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout)["checks"]


@pytest.mark.pipeline
def test_the_tests_of_every_kind_pass(written, tmp_path):
    tests = [str(package / "tests") for package in written.values()]
    done = run(
        written, "-c", PYTEST, "-q", "-p", "no:cacheprovider", "--import-mode=importlib", f"--rootdir={tmp_path}",
        *tests, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]


@pytest.mark.pipeline
def test_every_kind_but_methods_keeps_its_contract(written, tmp_path):
    """Of the rasterizer that is the slow part of its own tests, so it is left to those."""
    kinds = [kind for kind in written if kind not in ("method", "post-training", "anchors", "rasterizer")]
    found = check(written, kinds, tmp_path)
    assert [row for row in found if row["state"] != "ok"] == []
    assert sum("keeps the contract" in row["name"] for row in found) == 5


@pytest.mark.pipeline
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["anchors", "method", "post-training", "rasterizer"])
def test_a_method_passes_the_whole_check(written, tmp_path, kind):
    """By default the tutorial's package does, and these pass their own tests."""
    found = check(written, [kind], tmp_path)
    assert [row for row in found if row["state"] != "ok"] == []
    if kind != "rasterizer":
        (row,) = [row for row in found if row["name"].endswith("runs on a tiny scene")]
        assert "40 steps" in row["detail"]
        assert "resumes bit-equal" in row["detail"]


@pytest.mark.pipeline
@pytest.mark.slow
def test_a_method_that_only_encodes_passes_too(written, tmp_path):
    """A stage without steps: what post-training methods have that only code a trained scene."""
    package = packages.write_package(tmp_path, packages.kinds()["post-training"], packages.legal_names("only-encodes"))
    path = package / "src" / "sw_only_encodes" / "stage.py"
    stage = "    @property\n    def iterations(self):\n        return 0\n\n    def register_pre_task"
    path.write_text(path.read_text().replace("    def register_pre_task", stage, 1))
    found = check({"only-encodes": package}, ["only-encodes"], tmp_path)
    assert [row for row in found if row["state"] != "ok"] == []
    assert any(row["detail"].startswith("0 steps") for row in found)


FORGETS = """
    fired = 0

    def register_post_task(self, scheduler, ppl, opt):
        super().register_post_task(scheduler, ppl, opt)
        scheduler.register_task([4, 8, 12], self.fade, name="fade")

    def fade(self, model: SplatModel) -> None:
        self.fired += 1
        model.opacity_logits.data.sub_(0.1 * self.fired)
"""


@pytest.mark.pipeline
@pytest.mark.slow
def test_state_on_a_stage_that_ends_before_the_middle_is_found(tmp_path):
    package = packages.write_package(tmp_path, packages.kinds()["method"], packages.legal_names("forgets"))
    path = package / "src" / "sw_forgets" / "stage.py"
    path.write_text(path.read_text() + FORGETS)
    (row,) = [row for row in check({"": package}, [""], tmp_path) if row["name"].endswith("runs on a tiny scene")]
    assert row["state"] == "broken"
    assert "interrupted after step 3, 6," in row["detail"]
