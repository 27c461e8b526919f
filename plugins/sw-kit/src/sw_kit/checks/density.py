"""Check of a density control: a short training with it, as a whole and interrupted."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from sw_gaussians.config import GaussianTraining
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import DensityControl, GaussianModel, RasterOptions
from splatwizard_core.tooling import NegotiatedRasterizer, TrainingStopped
from sw_kit.checks.targets import make
from sw_kit.finding import hold
from sw_kit.samples import tiny_scene
from sw_kit.short_training import train_stages

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

STEPS = 40
STOPS = (9, 10, 25)
"""Steps after which the training is interrupted: the usual plans, scaled down, adjust at each or every second step."""
OPTIONS = {field.name for field in fields(RasterOptions) if field.type == "bool"}


def check_density_control(entry: Entry, plugins: PluginManager) -> str:
    """Hold a density control to a plan that scales, to options that there are, and to trainings that can go on."""
    control: DensityControl = make(entry, plugins)
    hold(isinstance(control, DensityControl), "it is no DensityControl", f"{entry.target}: subclass that of the api")
    rounds = control.rounds
    hold(isinstance(rounds, range) and rounds.start >= 0, f"rounds is {rounds!r}", "return a range of steps")
    hold(isinstance(control.until, int), f"until is {control.until!r}", "return a step")
    unknown = sorted(set(control.needs(1)) - OPTIONS)
    hold(not unknown, f"needs names {', '.join(unknown)}", f"RasterOptions has {', '.join(sorted(OPTIONS))}")
    whole = trained(entry, plugins)
    lengths = {name: len(getattr(whole, name)) for name in whole.ROWS}
    hold(len(set(lengths.values())) == 1, f"rows differ: {lengths}", "change rows with state.optimizer alone")
    hold(
        set(whole.ROWS) == set(GaussianModel.ROWS),
        f"a trained model still has {', '.join(sorted(set(whole.ROWS) - set(GaussianModel.ROWS)))}",
        "finish(model) takes back what begin gave the model",
    )
    finite = all(bool(torch.isfinite(p).all()) for p in whole.parameters())
    hold(finite, "a parameter is not finite after the training", "check what adjust computes")
    with tempfile.TemporaryDirectory() as folder:
        for stop in STOPS:
            with contextlib.suppress(TrainingStopped):
                trained(entry, plugins, directory=Path(folder), stop_after=stop)
        resumed = trained(entry, plugins, directory=Path(folder))
    hold(
        resumed.digest() == whole.digest(),
        f"a training that is interrupted after step {', '.join(map(str, STOPS))} and resumed ends as another model",
        "keep state in buffers of model.ROWS or in state_dict; draw from model.next_split_generator()",
    )
    return f"{STEPS} steps, {whole.num_rows} Gaussians; resumes bit-equal after step {', '.join(map(str, STOPS))}"


def trained(
    entry: Entry, plugins: PluginManager, *, directory: Path | None = None, stop_after: int | None = None
) -> GaussianModel:
    """Return the model of a short training on `demo:tiny`, with the whole plan scaled down."""
    scene, control = tiny_scene(), make(entry, plugins)
    stage = ThreeDGSStage(GaussianTraining(iterations=STEPS, scale_schedule=True), control)
    points = scene.points
    assert points is not None
    found = train_stages(
        [stage], scene, NegotiatedRasterizer(plugins, device=torch.device("cpu")),
        model=lambda: gaussians_from_points(points, **control.start_values()),
        directory=directory, stop_after=stop_after,
    )  # fmt: skip
    model: GaussianModel = found.model
    return model
