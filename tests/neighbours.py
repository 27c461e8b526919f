"""Packages of strangers as they lie installed beside ours: the example of this repository, and one with a thing of each
kind that declares as little as it may. What holds of ours must not depend on who else is there."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NEIGHBOUR = '''
"""One thing of each kind, with the fewest fields."""

from splatwizard_core.api import hookimpl

KINDS = (
    "rasterizers", "pruners", "quantizers", "entropy_models", "context_models", "coders", "tasks", "methods",
    "datasets", "downloads", "metrics", "exporters", "importers", "executors", "checks", "commands",
)
DECLARED = {"coders": {"codes": "gaussians"}}


def register(hook):
    def implementation(registry):
        registry.add("neighbour-" + hook.replace("_", "-"), f"neighbour_parts:{hook}", summary="of a neighbour",
                     **DECLARED.get(hook, {}))

    implementation.__name__ = f"register_{hook}"
    return hookimpl(implementation)


for kind in KINDS:
    globals()[f"register_{kind}"] = register(kind)
'''
PARTS = '''
"""The things themselves."""

import click
from splatwizard_core.api import Method, OptimizationParams


class methods(Method):
    name = "neighbour-methods"
    Config = OptimizationParams
    PRESETS = {"paper": {}}
    RATES = {"r1": {}}


class pruners:
    uses_statistics = False

    def score(self, model, cameras, rasterizer, background):
        return model.opacities.detach()


class datasets:
    def detect(self, path):
        return 0.0

    def load(self, path, options):
        raise NotImplementedError


class Thing:
    pass


rasterizers = quantizers = entropy_models = context_models = coders = tasks = executors = Thing


def metrics(render, truth):
    return float((render - truth).abs().max())


def exporters(model, path):
    path.write_text("nothing")


def importers(path):
    raise NotImplementedError


def downloads():
    return b""


def checks():
    return []


@click.command()
def commands():
    """Do nothing."""
'''


def put_neighbours(folder: Path) -> list[Path]:
    """Write the neighbours' files into `folder`; return what has to be on the path for them to be installed."""
    for name, module in (("sw-neighbour", "neighbour"), ("sw-third-party", "sw_third_party.plugin")):
        about = folder / f"{name.replace('-', '_')}-0.1.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        (about / "entry_points.txt").write_text(f"[splatwizard]\n{name.removeprefix('sw-')} = {module}\n")
    (folder / "neighbour.py").write_text(NEIGHBOUR)
    (folder / "neighbour_parts.py").write_text(PARTS)
    return [folder, ROOT / "examples" / "sw-third-party" / "src"]
