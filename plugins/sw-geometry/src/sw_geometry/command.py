"""`sw mesh`: the surface of a scene as a triangle mesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import (
    OUTPUT_FILE,
    OUTPUT_FOLDER,
    SCENE,
    Choices,
    debug_option,
    existing_file,
    json_option,
    options,
    print_json,
    set_option,
)

if TYPE_CHECKING:
    from splatwizard_core.api import Subject
    from sw_geometry.build import Built
    from sw_geometry.parameters import Parameters
    from sw_geometry.settings import MeshSettings

MESH = ".ply"
LENGTH = click.FloatRange(min=0, min_open=True)


def _depths(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    return [mode for mode in ("expected", "median", "ratio=") if mode.startswith(incomplete)]


def _target(context: click.Context, parameter: click.Parameter, value: str | None) -> Path | None:
    """A folder, or a .ply that is not there as a folder."""
    if value is None:
        return None
    is_file = Path(value).suffix.lower() == MESH and not Path(value).is_dir()
    return (OUTPUT_FILE if is_file else OUTPUT_FOLDER).convert(value, parameter, context)


@click.command(short_help="the surface of a scene as a triangle mesh")
@click.argument("file", metavar="FILE|RUN", type=click.Path())
@options(
    click.option("--scene", metavar="SCENE", type=SCENE,
                 help="Whose cameras see it.  [default: that of the run directory, or of the one that FILE lies in]"),
    click.option("--out", metavar="DIR|FILE.ply", type=click.Path(), callback=_target,
                 help="Folder for mesh.ply, mesh_post.ply, mesh.png, mesh.json; or one file, for the mesh of "
                 "mesh_post.ply alone.  [default: RUN/mesh, else mesh]"),
    click.option("--voxel-size", type=LENGTH, metavar="X",
                 help="Edge of a voxel, scene units.  [default: depth-trunc / mesh-res; DTU 0.004]"),
    click.option("--sdf-trunc", type=LENGTH, metavar="X",
                 help="Reach of the signed distance, scene units.  [default: 5 voxels; DTU 4]"),
    click.option("--depth-trunc", type=LENGTH, metavar="X",
                 help="Leave out larger depths, scene units.  [default: twice the cameras' distance; DTU 3]"),
    click.option("--mesh-res", type=click.IntRange(8, 65_536), metavar="N",
                 help="Voxels along depth-trunc, or of the unbounded grid.  [default: 1024; unbounded 256]"),
    click.option("--clusters", type=click.IntRange(min=1), metavar="K",
                 help="Largest pieces that stay in mesh_post.ply.  [default: 50; DTU 1]"),
    click.option("--min-views", type=click.IntRange(min=1), metavar="N",
                 help="Views that must have seen a voxel.  [default: 1]"),
    click.option("--depth", metavar="MODE", shell_complete=_depths,
                 help="expected, median, or ratio=R between them.  [default: what the file says, else median for DTU, "
                 "else expected]"),
    click.option("--alpha-min", type=click.FloatRange(0, 1), metavar="A",
                 help="Pixels that are less opaque show no surface.  [default: 0.5]"),
    click.option("--views", type=click.Choice(["train", "all"]), help="Whose depth is fused.  [default: train]"),
    click.option("--unbounded", is_flag=True, default=None,
                 help="Experimental: contracted space, for a far background."),
    click.option("--no-mask", is_flag=True, help="Do not cut depth by the scene's masks."),
    click.option("--cull", type=click.Choice(["all", "any", "none"]),
                 help="DTU: cut by the masks of all views, of any, or not.  [default: all for DTU]"),
    click.option("--units", type=click.Choice(["scene", "mm"]), default="scene", show_default=True,
                 help="DTU: units of the scene's cameras."),
    click.option("--chamfer", is_flag=True, help="Measure the mesh against the scene's truth, or DTU's."),
    click.option("--world", is_flag=True,
                 help="Write coordinates of the world that the scene's files are in, as doubles, where the scene was "
                 "moved to a local origin."),
    click.option("--backend", type=click.Choice(["tensor", "legacy"]),
                 help="Class of Open3D that fuses; legacy needs Open3D before 0.20.  [default: tensor]"),
    click.option("--max-memory", type=LENGTH, metavar="GB",
                 help="What the grid may take.  [default: half of the machine's]"),
    click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]),
                 help="Where to draw.  [default: auto, which is CUDA if its kernels can run]"),
    set_option, json_option, debug_option,
)  # fmt: skip
def mesh(
    file: str, scene: str | None, out: Path | None, no_mask: bool, units: str, chamfer: bool, world: bool,
    device: str | None, sets: tuple[str, ...], as_json: bool, **given: Any,
) -> None:  # fmt: skip
    """Make a mesh of FILE (.swz or .ply), or of the scene.swz in a run directory.

    The model is drawn from the training cameras of the scene, any model whose rasterizer gives depth; its depth maps
    are fused into a signed distance, whose surface is the mesh. mesh.ply is all of it, mesh_post.ply its largest
    pieces, mesh.json says how it was made. --set takes scene keys, keys of the run (raster.prefer, ...), and
    metrics.mesh.KEY, which options win over.
    """
    from splatwizard_core.api import SplatwizardError
    from splatwizard_core.tooling import (
        NegotiatedRasterizer,
        file_sha256,
        load_plugins,
        open_session,
        open_subject,
    )
    from sw_geometry.files import POST, write_files
    from sw_geometry.metrics import build_from_model
    from sw_geometry.open3d_import import Open3DMissing, import_open3d
    from sw_geometry.parameters import resolve, stated
    from sw_geometry.ply import write_mesh

    run = Path(file) if (Path(file) / "config.toml").is_file() else None
    path = existing_file(run / "scene.swz" if run is not None else file)
    config = None if run is None else str(run / "config.toml")
    target = out or (run / "mesh" if run is not None else Path("mesh"))
    choices = Choices(scene=scene, config_file=config, sets=sets, device=device)
    chosen = choices.of_file(path).resolve_without_method()
    settings, setup = _settings(chosen.metrics, given, no_mask)
    try:
        import_open3d()  # before the work, not after it
    except Open3DMissing as error:
        raise SplatwizardError(str(error)) from error  # nothing is wrong with what was asked: status 1

    session = open_session(chosen, load_plugins())
    setup.device = session.device
    subject = replace(open_subject(path, session, chosen), setup=setup)
    assert isinstance(subject.rasterizer, NegotiatedRasterizer)  # a session has no other
    loaded = subject.scene
    parameters = resolve(settings, loaded, stated(subject.model, subject.static))
    built = build_from_model(subject, parameters, settings.max_memory)
    scores, culled = _measured(subject, parameters, settings, built, units=units, asked=chamfer)
    facts = {
        **built.facts, "model": path.name, "sha256": file_sha256(path), "scene": loaded.name,
        "world_origin": list(loaded.origin), "world_coordinates": world,
        "rasterizers": dict(subject.rasterizer.choices), **({"chamfer": scores} if scores else {}),
    }  # fmt: skip
    alone = target.suffix.lower() == MESH and not target.is_dir()
    if alone:
        write_mesh(built.post, target, loaded.origin if world else None)
    files = [target.name] if alone else write_files(target, built, loaded, facts, culled, world=world)
    if as_json:
        print_json({**facts, "folder": str(target.parent if alone else target), "files": files})
        return
    click.echo(
        f"mesh: {len(built.post.vertices):,} vertices, {len(built.post):,} triangles, "
        f"voxel {parameters.voxel_size:.4g}, {built.facts['seconds']:.1f} s: {target if alone else target / POST}"
    )
    if any(loaded.origin) and not world:
        about = f"its coordinates are those about the scene's local origin, which lies at {loaded.origin}"
        click.echo(f"{about} (--world adds it)")
    for name, value in scores.items():
        click.echo(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")


def _settings(configured: Any, given: dict[str, Any], no_mask: bool) -> tuple[MeshSettings, Any]:
    """Settings from metrics.mesh.KEY with the options over them, and a setup of metrics that holds them."""
    import torch

    from splatwizard_core.api import MetricSetup
    from sw_geometry.metrics import GROUP
    from sw_geometry.settings import MeshSettings

    values = {**configured.get(GROUP, {}), **{k: v for k, v in given.items() if v is not None}}
    if no_mask:
        values["mask"] = False
    setup = MetricSetup(torch.device("cpu"), {GROUP: values})
    return setup.read(MeshSettings, GROUP), setup


def _measured(
    subject: Subject, parameters: Parameters, settings: MeshSettings, built: Built, *, units: str, asked: bool
) -> tuple[dict[str, Any], Any]:
    """(scores of the mesh if they are asked for, what culling left in millimetres if the scene is DTU's).

    Raises UserInputError where there is nothing to compare with.
    """
    from splatwizard_core.api import CapabilityError, UserInputError
    from sw_geometry import chamfer, dtu, dtu_scene

    scene, left = subject.scene, None
    if "scale_mats" in scene.ground_truth:
        left = built.post if units == "mm" else dtu_scene.culled(built.post, scene, parameters.cull)
        left = left if units == "mm" else dtu_scene.in_millimetres(left, scene)
    if not asked:
        return {}, left
    scan = dtu.scan_number(scene.path or scene.name) if scene.protocol.dataset == "dtu" else None
    try:
        if scan is not None and left is not None:
            official = dtu.read_official(dtu_scene.official_folder(settings.dtu_gt), scan)
            return {"protocol": dtu.PROTOCOL, "unit": "mm", **dtu.mesh_distance(left, official)}, left
    except CapabilityError as error:
        raise UserInputError(str(error)) from error
    truth = chamfer.Truth.of(scene)
    if truth is None:
        raise UserInputError(f"--chamfer: scene {scene.name} brings no surface to compare with; leave it out")
    tau = settings.tau or chamfer.default_tau(scene)
    return {"protocol": chamfer.PROTOCOL, "unit": "scene", "tau": tau, **chamfer.compare(built.post, truth, tau)}, left
