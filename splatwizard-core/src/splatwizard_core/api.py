"""The face of the core for methods, rasterizers, codecs, metrics and data sets: at most 80 names, stable since 0.2.

docs/plugins.md describes each. Everything else in `splatwizard_core` may change with any release.
"""

from __future__ import annotations

from splatwizard_native import lazy_exports

MODULES = {
    "plugins.hookspecs": "hookimpl",
    "plugins.registry": "Registry",
    "plugins.manager": "PluginManager",
    "errors": (
        "SplatwizardError BitstreamError CapabilityError ConfigError EmptyModel PluginError SceneError ShapeError "
        "UserInputError"
    ),
    "method": "Method create_method",
    "scene.camera": "Camera",
    "scene.scene": "View Scene PointCloud Protocol",
    "scene.dataset": "SceneOptions Dataset",
    "gaussians.splat_model": "SplatModel",
    "gaussians.model": "GaussianModel",
    "gaussians.invalid_rows": "LeftOut leave_out_senseless",
    "gaussians.placement": "placed_in",
    "gaussians.inputs": "GaussianInputs SH SH_C0 rgb_to_dc",
    "rendering.rasterizer": "Rasterizer RasterOptions RenderResult RasterStats AccumOutput GradBuffer ScoreSpec",
    "rendering.features": "Feature",
    "rendering.info": "RasterizerInfo",
    "training.stage": "Stage StageContext CameraSampler CameraIterator",
    "training.scheduler": "Scheduler",
    "training.state": "TrainingState",
    "training.task_log": "TaskLog",
    "training.plan": "When",
    "training.overrides": "apply_overrides",
    "training.params": "OptimizationParams PipelineParams Params InputFile SameResult",
    "training.identity": "given_values",
    "training.optimizer": "SplatOptimizer ParamGroup",
    "training.losses": "LossPack photometric_loss",
    "training.pruner": "Pruner",
    "training.density": "DensityControl",
    "streams": "stream",
    "coding.container": "ContainerReader ContainerWriter",
    "coding.limits": "beyond_limit",
    "coding.contracts": (
        "Quantizer EntropyModel ContextModel EntropyCoder PositionCodec ArrayCoder VectorCoder GaussianCodec"
    ),
    "evaluation.image": "psnr ssim_map",
    "evaluation.evaluate": "MetricResult Subject",
    "evaluation.metrics": "MetricSetup PreparedMetric",
}
"""Module of the core -> the names that it lends. `api.pyi` repeats them for type checkers."""
BASE = {"files": "replacing", "progress": "track"}
"""The same of splatwizard-native."""
OLDER = {"gaussians.placement": "origin_of world_shift"}
"""Names of 0.2 that go with 0.4."""

__all__, __getattr__ = lazy_exports(__name__, MODULES, BASE, OLDER)
