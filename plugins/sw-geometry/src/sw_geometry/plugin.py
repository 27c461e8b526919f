"""Registers `sw mesh`, the metrics of geometry, and the check of Open3D."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("mesh", "sw_geometry.command:mesh", position=4.5,
                 summary="the surface of a scene as a triangle mesh")  # fmt: skip


@hookimpl
def register_metrics(registry: Registry) -> None:
    for name, target, label, unit, digits, direction, position, summary in (
        ("chamfer_dtu", "DTU_CHAMFER", "Chamfer", "mm", 2, "lower", 20, "mesh against the scanner, DTU's protocol, mm"),
        ("chamfer", "CHAMFER", "Chamfer", "", 4, "lower", 21, "mesh against the truth of the scene, its units"),
        ("mesh_f1", "F_SCORE", "mesh F1", "", 3, "higher", 22, "share of mesh and truth within tau of each other"),
        ("chamfer_points", "POINTS", "Chamfer, points", "", 4, "lower", 23,
         "centres of the Gaussians against the truth, with metrics.mesh.points=true"),
        ("depth_error", "DEPTH", "depth error", "", 4, "lower", 24, "mean relative error of the depth, test views"),
        ("normal_error", "NORMALS", "normals", "deg", 1, "lower", 25, "mean angle to the true normals, degrees"),
    ):  # fmt: skip
        registry.add(name, f"sw_geometry.metrics:{target}", summary=summary, label=label, unit=unit, digits=digits,
                     direction=direction, position=position, over="model", slow=True, group="mesh",
                     settings="sw_geometry.settings:MeshSettings")  # fmt: skip


@hookimpl
def register_checks(registry: Registry) -> None:
    registry.add("Open3D", "sw_geometry.check:check_open3d", group="geometry", needs="torch",
                 summary="Open3D, which makes meshes, and the libraries that it needs")  # fmt: skip
