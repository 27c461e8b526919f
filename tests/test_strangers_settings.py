"""A codec and a pruner of a package that nobody knows, with settings of their own, in a method of ours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from strangers_site import Site

from splatwizard_core.coding.container import ContainerReader

pytestmark = pytest.mark.pipeline

THEIRS = """
from pydantic import Field
from splatwizard_core.api import GaussianModel, Params, hookimpl


@hookimpl
def register_coders(registry):
    registry.add("their-codec", "sw_theirs:TheirCodec", summary="float32, and a level", codes="gaussians")


@hookimpl
def register_pruners(registry):
    registry.add("their-pruner", "sw_theirs:TheirPruner", summary="the faintest go")


class CodecSettings(Params):
    level: int = Field(1, ge=1, le=9, description="effort")
    words: list[str] = Field([], description="words for the header")


class TheirCodec:
    Settings = CodecSettings

    def __init__(self, plugins, level=1, words=()):
        self.plugins, self.level, self.words = plugins, level, words

    def encode(self, model, writer):
        writer.static["level"], writer.static["words"] = self.level, list(self.words)
        self.plugins.gaussian_codecs.load("gaussians-exact")(self.plugins).encode(model, writer)

    def decode(self, reader):
        return self.plugins.gaussian_codecs.load("gaussians-exact")(self.plugins).decode(reader)


class TheirPruner:
    uses_statistics = False

    def score(self, model, cameras, rasterizer, background=None):
        return model.opacities.detach()
"""
RUN = [
    "run", "--method", "trimming-the-fat", "--scene", "demo:tiny", "--set", "pretrained.iterations=20",
    "--set", "iterations=8", "--set", "prune.start=3", "--set", "prune.pruner=their-pruner",
    "--set", "codec=their-codec",
]  # fmt: skip


@pytest.fixture(scope="module")
def sw(tmp_path_factory: pytest.TempPathFactory):
    """sw(*arguments): a finished process of `sw` where the distribution sw-theirs is installed."""
    site = Site(tmp_path_factory.mktemp("theirs"))
    site.install("sw-theirs", THEIRS)
    return lambda *arguments: site.sw(*arguments, check=False)


def test_their_settings_are_parsed_recorded_and_reach_their_codec(sw, tmp_path: Path):
    sets = ["--set", "codec.settings.level=7", "--set", "codec.settings.words=a,b"]
    done = sw(*RUN, *sets, "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    (file,) = tmp_path.glob("**/scene.swz")
    header = ContainerReader(file.read_bytes(), "scene.swz")
    assert (header.static["codec"], header.static["level"], header.static["words"]) == ("their-codec", 7, ["a", "b"])
    record = json.loads((file.parent / "metrics.json").read_text())
    assert record["config"]["config"]["codec"] == {"name": "their-codec", "settings": {"level": 7, "words": ["a", "b"]}}
    again = sw("encode", str(file.parent), "--set", "codec.settings.level=2", "--out", str(tmp_path / "again.swz"))
    assert again.returncode == 0, again.stderr[-2000:]
    static = ContainerReader((tmp_path / "again.swz").read_bytes(), "again.swz").static
    assert (static["level"], static["words"]) == (2, ["a", "b"])


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("codec.settings.levle=7", "unknown key 'codec.settings.levle' in --set: did you mean 'codec.settings.level'?"),
        ("codec.settings.level=70", "must be less than or equal to 9 (effort)"),
        ("prune.settings.power=2", "'their-pruner' (prune.pruner) has no settings: leave it out, or name another one"),
    ],
)
def test_a_wrong_setting_of_theirs_ends_before_anything_runs(sw, tmp_path: Path, setting: str, told: str):
    done = sw(*RUN, "--set", setting, "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr.splitlines()) <= 2
    assert not (tmp_path / "out").exists()
