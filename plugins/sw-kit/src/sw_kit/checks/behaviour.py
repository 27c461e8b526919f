"""Checks of what an entry does, by kind: it is used on small things, and held to its contract."""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from PIL import Image

from splatwizard_core.api import CapabilityError, MetricResult, MetricSetup, PreparedMetric, RasterOptions, Subject
from splatwizard_core.tooling import Check, NegotiatedRasterizer
from sw_kit.checks.coding import check_coder
from sw_kit.checks.density import check_density_control
from sw_kit.checks.rasterizer import check_rasterizer
from sw_kit.checks.targets import make
from sw_kit.finding import NotCheckedError, hold
from sw_kit.samples import some_gaussians, tiny_scene

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CPU = torch.device("cpu")
PUBLISHED = 0.8
"""From this score on a family claims a folder against those of mere layouts, which answer 0.5."""


def check_pruner(entry: Entry, plugins: PluginManager) -> str:
    """Hold a pruner to one number per Gaussian, to be repeatable, and to leave model and gradients as they are."""
    pruner, model = make(entry, plugins), some_gaussians()
    if pruner.uses_statistics:
        generator = torch.Generator().manual_seed(1)
        model.grad_accum.copy_(torch.rand(model.num_rows, generator=generator))
        model.denom.fill_(3)
    model.means.grad = torch.ones_like(model.means)
    before = model.digest()
    cameras = [view.camera for view in tiny_scene().train[:4]]
    rasterizer = NegotiatedRasterizer(plugins, device=CPU)
    orders = (cameras, cameras, cameras[::-1])
    first, again, backward = (pruner.score(model, each, rasterizer, torch.zeros(3)) for each in orders)
    mend = f"{entry.target}: score() is a function of the model and its views"
    hold(
        tuple(first.shape) == (model.num_rows,) and first.is_floating_point(),
        f"score gives {first.dtype} {list(first.shape)} for {model.num_rows} Gaussians",
        "return one float a row",
    )
    hold(not bool(first.isnan().any()), "a score is not a number", "-inf stands for what no camera sees")
    hold(model.digest() == before, "score changes the model", mend)
    kept = all(p.grad is None for name, p in model.named_parameters() if name != "means")
    hold(kept and bool((model.means.grad == 1).all()), "score changes gradients", "use torch.autograd.grad")
    hold(torch.equal(first, again), "a second call gives other scores", mend)
    same = torch.allclose(first, backward, rtol=1e-3, atol=1e-6 * float(first[first.isfinite()].abs().max()))
    hold(same, "other scores for the cameras in reverse order", "every camera counts once, whatever the order")
    return f"{model.num_rows} scores, {len(first.unique())} different"


def check_metric(entry: Entry, plugins: PluginManager) -> str:
    """Hold a metric to one finite number, repeatable, on images that stay as they are, in the declared direction."""
    target = entry.load()
    if entry.declared.get("over") in ("views", "model"):
        return _check_model_metric(entry, plugins)
    try:
        prepared = target.prepare(MetricSetup(CPU)) if hasattr(target, "prepare") else PreparedMetric(target)
    except CapabilityError as error:
        raise NotCheckedError(str(error), "check where it can be computed") from error
    truth = tiny_scene().test[0].image()
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(2))
    near, far = ((truth + sigma * noise).clamp(0, 1) for sigma in (0.02, 0.3))
    kept = [each.clone() for each in (truth, near, far)]
    values = [prepared.compute(render, truth) for render in (near, near, far)]
    for value in values:
        hold(isinstance(value, (int, float)), f"it returns a {type(value).__name__}", "return float(...)")
        hold(math.isfinite(value), f"it returns {value} for different images", "return a finite number")
    hold(all(map(torch.equal, kept, (truth, near, far))), "it changes the images", "work on copies")
    hold(values[0] == values[1], f"a second call gives {values[1]}, not {values[0]}", "seed what is random")
    better = values[0] > values[2] if entry.declared["direction"] == "higher" else values[0] < values[2]
    hold(
        better,
        f"{values[0]:g} for a little noise, {values[2]:g} for much",
        f"direction='{entry.declared['direction']}' says the opposite",
    )
    return f"{values[0]:.4g} for a little noise, {values[2]:.4g} for much"


def _check_model_metric(entry: Entry, plugins: PluginManager) -> str:
    """Hold a metric over models to a MetricResult or None, repeatable, and to leave the model as it is."""
    model, scene = some_gaussians(), tiny_scene()
    before, values = model.digest(), []
    for _ in range(2):
        setup = MetricSetup(CPU)
        subject = Subject(model, scene, NegotiatedRasterizer(plugins, device=CPU), RasterOptions(), setup, {})
        try:
            found = entry.load()(subject)
        except CapabilityError as error:
            raise NotCheckedError(str(error), "check where it can be computed") from error
        if found is None:
            return "does not apply to demo:tiny"
        hold(isinstance(found, MetricResult), f"it returns a {type(found).__name__}", "return a MetricResult or None")
        hold(
            found.mean is not None and math.isfinite(found.mean), f"its mean is {found.mean}", "return a finite number"
        )
        values.append(found.mean)
    hold(model.digest() == before, "it changes the model", "work on a copy")
    hold(values[0] == values[1], f"a second call gives {values[1]}, not {values[0]}", "seed what is random")
    return f"{values[0]:.4g} for 200 Gaussians that nobody trained"


def check_dataset(entry: Entry, plugins: PluginManager) -> str:
    """Hold a family to scores within 0..1, 0 for folders that hold no scene, and modest ones for others' layouts."""
    family = make(entry, plugins)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        nothing, layouts = _foreign_folders(root)
        for path in [*nothing, *layouts]:
            score = family.detect(path)
            where = f"detect gives {score!r} for {path.relative_to(root)}"
            hold(isinstance(score, (int, float)) and 0 <= score <= 1, where, "it must be a number in 0..1")
            hold(path in layouts or score == 0, where, "that is no scene: 0")
            hold(score < PUBLISHED, where, f"a scene of another family: below {PUBLISHED}, which is for one's own")
    return f"0..1 on {len(nothing) + len(layouts)} foreign folders"


def _foreign_folders(root: Path) -> tuple[list[Path], list[Path]]:
    """Folders (and what is none) without a scene, and folders of common layouts that name no published collection."""
    paths = {name: root / name for name in ("empty", "notes", "pictures", "colmap", "blender")}
    for path in paths.values():
        path.mkdir()
    (paths["notes"] / "README.md").write_text("nothing")
    (paths["pictures"] / "images").mkdir()
    Image.new("RGB", (4, 4)).save(paths["pictures"] / "images" / "a.png")
    (paths["colmap"] / "sparse" / "0").mkdir(parents=True)
    (paths["colmap"] / "images").mkdir()
    for name in ("cameras", "images", "points3D"):
        (paths["colmap"] / "sparse" / "0" / f"{name}.txt").write_text("# empty\n")
    for split in ("train", "test"):
        (paths["blender"] / f"transforms_{split}.json").write_text('{"camera_angle_x": 0.7, "frames": []}')
    nothing = [paths["empty"], paths["notes"], paths["pictures"], paths["notes"] / "README.md", root / "not-there"]
    return nothing, [paths["colmap"], paths["blender"]]


def check_exporter(entry: Entry, plugins: PluginManager) -> str:
    """Hold an exporter to write its format and leave the model; what an importer reads back has as many rows."""
    return _through_file(entry, plugins, entry, _of_suffix(plugins.importers, entry))


def check_importer(entry: Entry, plugins: PluginManager) -> str:
    """Hold an importer to read what the exporter of its suffix writes."""
    exporter = _of_suffix(plugins.exporters, entry)
    if exporter is None:
        raise NotCheckedError(f"nothing installed writes {entry.declared['suffix']}", "test it with files of your own")
    return _through_file(entry, plugins, exporter, entry)


def _of_suffix(registry: Any, entry: Entry) -> Entry | None:
    return next((each for each in registry if each.declared.get("suffix") == entry.declared["suffix"]), None)


def _through_file(entry: Entry, plugins: PluginManager, exporter: Entry, importer: Entry | None) -> str:
    model = some_gaussians()
    before = model.digest()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{entry.declared['suffix']}"
        exporter.load()(model, path)
        hold(path.is_file() and path.stat().st_size, "no file is written", f"{exporter.target}: write to `path`")
        hold(model.digest() == before, "it changes the model", f"{exporter.target}: work on copies")
        size = path.stat().st_size
        found = None if importer is None else importer.load()(path).num_rows
    hold(found in (None, model.num_rows), f"{model.num_rows} Gaussians, read back are {found}", "keep all of them")
    return f"{model.num_rows} Gaussians in {size:,} bytes" + (", and back" if importer else "")


def check_check(entry: Entry, plugins: PluginManager) -> str:
    """Hold a check of the machine to return findings."""
    found = entry.load()()
    good = isinstance(found, list) and all(isinstance(each, Check) for each in found)
    hold(good, f"it returns {type(found).__name__}", "return list[Check] (splatwizard_core.tooling)")
    return f"{len(found)} findings"


def check_download(entry: Entry, plugins: PluginManager) -> str:
    """Hold a registry of data sets to be TOML."""
    return f"{len(tomllib.loads(entry.load()().decode()))} tables"


BEHAVIOUR: Mapping[str, Callable[[Entry, PluginManager], str]] = {
    "pruner": check_pruner,
    "density control": check_density_control,
    "metric": check_metric,
    "dataset": check_dataset,
    "rasterizer": check_rasterizer,
    "coder": check_coder,
    "exporter": check_exporter,
    "importer": check_importer,
    "check": check_check,
    "download": check_download,
}
