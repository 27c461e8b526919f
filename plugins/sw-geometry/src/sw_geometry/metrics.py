"""Metrics of a model's geometry: `sw eval --geometry`, `sw run --geometry`.

One mesh serves all of them. A scene without a truth of a kind has no such value; where a truth is there and something
else is missing, the reason stands in the record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from splatwizard_core.api import CapabilityError, MetricResult, MetricSetup, SplatwizardError, Subject, UserInputError
from sw_geometry import chamfer, dtu, dtu_scene
from sw_geometry.build import Built, build
from sw_geometry.chamfer import Truth, default_tau
from sw_geometry.depth import depth_views
from sw_geometry.files import write_files
from sw_geometry.maps import depth_and_normal_error
from sw_geometry.mesh import Mesh
from sw_geometry.open3d_import import Open3DMissing, import_open3d
from sw_geometry.parameters import Parameters, resolve, stated
from sw_geometry.settings import MeshSettings

GROUP = "mesh"
Measure = Callable[[Subject], "MetricResult | None"]


@dataclass(frozen=True)
class GeometryMetric:
    """A metric over models that says itself what keeps it from being computed."""

    measure: Measure
    needs_mesh: bool = True

    def __call__(self, subject: Subject) -> MetricResult | None:
        """Measure; whatever is wrong becomes the reason of a null and spoils no other metric."""
        try:
            return self.measure(subject)
        except Open3DMissing as error:
            raise CapabilityError(f"package-missing: {error}") from error
        except (CapabilityError, MemoryError):
            raise
        except (SplatwizardError, ValueError, OSError) as error:
            raise CapabilityError(str(error)) from error

    def identity(self, setup: MetricSetup) -> str | None:
        """Settings and version of Open3D; None if it cannot be imported."""
        settings = setup.read(MeshSettings, GROUP).model_dump_json(exclude_unset=True)
        return f"{settings}, open3d {import_open3d().__version__}" if self.needs_mesh else settings

    def unavailable(self, setup: MetricSetup) -> str | None:
        """One line if Open3D is missing. Raises ConfigError for a bad setting."""
        setup.read(MeshSettings, GROUP)
        if self.needs_mesh:
            try:
                import_open3d()
            except Open3DMissing as error:
                return f"{error}; until then there is no Chamfer distance"
        return None


def settings_of(subject: Subject) -> MeshSettings:
    """The settings `metrics.mesh.KEY` of an evaluation."""
    return subject.setup.read(MeshSettings, GROUP)


def parameters_of(subject: Subject) -> Parameters:
    """Parameters of the mesh of a subject."""
    return resolve(settings_of(subject), subject.scene, stated(subject.model, subject.static))


def mesh_of(subject: Subject) -> Built:
    """The mesh of a subject, made once for all metrics; its files are written where the subject keeps some."""

    def make() -> Built:
        settings, parameters = settings_of(subject), parameters_of(subject)
        built = build_from_model(subject, parameters, settings.max_memory)
        if subject.keep is not None:
            write_files(subject.keep, built, subject.scene, built.facts)
        return built

    return subject.setup.share("sw-geometry mesh", make)


def build_from_model(subject: Subject, parameters: Parameters, max_memory: float | None) -> Built:
    """Draw the depth of the model from the cameras of its scene and fuse it."""
    if parameters.unbounded:
        if parameters.backend == "legacy":
            raise UserInputError("the legacy backend knows bounded scenes only: leave out unbounded or backend")
        from sw_geometry.unbounded import build_unbounded

        make = build_unbounded
    else:
        make = build
    scene = subject.scene
    views = scene.train if parameters.views == "train" else [*scene.train, *scene.test]
    views = list({view.name: view for view in views}.values())
    drawn = depth_views(
        subject.model, views, subject.rasterizer, subject.options,
        depth_ratio=parameters.depth_ratio, alpha_min=parameters.alpha_min, mask=parameters.mask,
    )  # fmt: skip
    return make(drawn, len(views), parameters, max_memory=max_memory, label=f"fuse depth of {scene.name}")


def _made_with(built: Built) -> dict[str, Any]:
    return {key: value for key, value in built.facts.items() if key not in ("seconds", "grid_bytes")}


def _scores(subject: Subject) -> dict[str, float] | None:
    """Scores of the mesh against the truth of its scene; None if the scene brings none."""
    truth = subject.setup.share("sw-geometry truth", lambda: Truth.of(subject.scene))
    if truth is None:
        return None
    tau = settings_of(subject).tau or default_tau(subject.scene)
    built = mesh_of(subject)
    return subject.setup.share("sw-geometry scores", lambda: chamfer.compare(built.post, truth, tau))


def analytic_chamfer(subject: Subject) -> MetricResult | None:
    """Chamfer distance of the mesh to the truth that the scene brings, units of the scene."""
    scores = _scores(subject)
    if scores is None:
        return None
    tau = settings_of(subject).tau or default_tau(subject.scene)
    details = {
        "protocol": chamfer.PROTOCOL,
        "unit": "scene",
        "tau": tau,
        **scores,
        "mesh": _made_with(mesh_of(subject)),
    }
    return _result(scores["overall"], "lower", details)


def f_score(subject: Subject) -> MetricResult | None:
    """F-score of the mesh at tau: harmonic mean of precision and recall."""
    scores = _scores(subject)
    if scores is None:
        return None
    tau = settings_of(subject).tau or default_tau(subject.scene)
    kept = {name: scores[name] for name in ("precision", "recall", "f1")}
    return _result(scores["f1"], "higher", {"protocol": chamfer.PROTOCOL, "unit": "", "tau": tau, **kept})


def point_chamfer(subject: Subject) -> MetricResult | None:
    """Chamfer distance of the Gaussians' centres to the truth, on request: metrics.mesh.points=true."""
    if not settings_of(subject).points:
        return None
    centers = _centers(subject)
    scan = _scan_of(subject)
    if scan is not None:
        cloud = dtu_scene.culled(centers, subject.scene, parameters_of(subject).cull)
        official = dtu.read_official(dtu_scene.official_folder(settings_of(subject).dtu_gt), scan)
        found = dtu.point_distance(dtu_scene.in_millimetres(cloud, subject.scene).vertices, official)
        return _result(found["overall"], "lower", {"protocol": dtu.POINTS_PROTOCOL, "unit": "mm", **found})
    truth = subject.setup.share("sw-geometry truth", lambda: Truth.of(subject.scene))
    if truth is None:
        return None
    tau = settings_of(subject).tau or default_tau(subject.scene)
    found = chamfer.compare_points(centers.vertices, truth, tau)
    protocol = f"{chamfer.PROTOCOL}-points"
    return _result(found["overall"], "lower", {"protocol": protocol, "unit": "scene", "tau": tau, **found})


def _centers(subject: Subject) -> Mesh:
    """Centres of the Gaussians that the first training view sees of the model, as a mesh without triangles."""
    import numpy as np
    import torch

    camera = subject.scene.train[0].camera.to(subject.model.device)
    with torch.no_grad():
        means = subject.model.gaussians(camera, subject.rasterizer).means.double().cpu().numpy()
    return Mesh(means[np.isfinite(means).all(axis=1)], np.zeros((0, 3), dtype=np.int64))


def _scan_of(subject: Subject) -> int | None:
    is_dtu = subject.scene.protocol.dataset == "dtu"
    return dtu.scan_number(subject.scene.path or subject.scene.name) if is_dtu else None


def dtu_chamfer(subject: Subject) -> MetricResult | None:
    """Chamfer distance of the mesh by the DTU protocol, mm."""
    scan = _scan_of(subject)
    if scan is None:
        return None
    official = dtu.read_official(dtu_scene.official_folder(settings_of(subject).dtu_gt), scan)
    built, parameters = mesh_of(subject), parameters_of(subject)
    found = measured_dtu(built.post, subject, parameters, official)[0]
    details = {"protocol": dtu.PROTOCOL, "unit": "mm", **found, "cull": parameters.cull, "mesh": _made_with(built)}
    return _result(found["overall"], "lower", details)


def measured_dtu(
    mesh: Mesh, subject: Subject, parameters: Parameters, official: dtu.Official
) -> tuple[dict[str, float], Mesh]:
    """(d2s, s2d, overall of a mesh in units of the scene, the culled mesh in millimetres)."""
    left = dtu_scene.in_millimetres(dtu_scene.culled(mesh, subject.scene, parameters.cull), subject.scene)
    return dtu.mesh_distance(left, official), left


def depth_error(subject: Subject) -> MetricResult | None:
    """Mean relative error of the depth over the test views, where the scene brings exact depth."""
    errors = _map_errors(subject)
    if "depth" not in errors:
        return None
    return _result(errors["depth"]["abs_rel"], "lower", {"protocol": "exact maps", "unit": "", **errors["depth"]})


def normal_error(subject: Subject) -> MetricResult | None:
    """Mean angle, degrees, between exact normals and those of the depth, over the test views."""
    errors = _map_errors(subject)
    if "normals" not in errors:
        return None
    return _result(errors["normals"]["mean"], "lower", {"protocol": "exact maps", "unit": "deg", **errors["normals"]})


def _map_errors(subject: Subject) -> Mapping[str, Mapping[str, float]]:
    """Errors of depth and normals, computed once; empty where the scene brings no exact maps."""
    scene = subject.scene
    if "depth" not in scene.ground_truth:
        return {}

    def compute() -> dict[str, dict[str, float]]:
        parameters = parameters_of(subject)
        return depth_and_normal_error(
            subject.model, scene.test, subject.rasterizer, subject.options, scene.ground_truth,
            depth_ratio=parameters.depth_ratio, alpha_min=parameters.alpha_min,
        )  # fmt: skip

    return subject.setup.share("sw-geometry maps", compute)


def _result(value: float, direction: str, details: Mapping[str, Any]) -> MetricResult:
    return MetricResult(value, [], direction, details=details)


CHAMFER, F_SCORE, POINTS = (
    GeometryMetric(analytic_chamfer),
    GeometryMetric(f_score),
    GeometryMetric(point_chamfer, False),
)
DTU_CHAMFER = GeometryMetric(dtu_chamfer)
DEPTH, NORMALS = GeometryMetric(depth_error, False), GeometryMetric(normal_error, False)
