"""The face of the core for packages about runs (reports, sweeps, diagnoses, viewers), besides `api`.

Documented in docs/plugins.md; unlike `api` it is not promised to stay as it is.
"""

from __future__ import annotations

from splatwizard_core.lending import lend

MODULES = {
    "plugins.manager": "load_plugins",
    "plugins.check": "Check State",
    "plugins.registry": "Entry",
    "plugins.loading": "PluginInfo",
    "runs.record": "Record read_record SCHEMA FILE_NAME",
    "runs.observers": "FinishedRun FinishedRuns StartedTraining TrainingObserver",
    "runs.lock": "directory_lock",
    "runs.config": "resolve",
    "runs.directory": "RunRequest",
    "runs.run": "run train_in",
    "runs.decode": "open_model",
    "runs.session": "Session",
    "runs.device": "choose_device",
    "scene.loading": "load_scene",
    "scene.locate": "DATA_VARIABLE",
    "files": "file_sha256 new_folder replacing write_atomic write_json",
    "progress": "Bar",
    "cores": "available_cores",
    "memory": "peak_rss_bytes reset_peak_rss rss_bytes",
    "coding.container": "decoded_limit",
    "evaluation.evaluate": "png_names",
    "evaluation.metrics": "MetricInfo short_reason",
    "errors": "NativeBuildError PluginError RunLockedError",
    "native.loader": "cache_root",
    "native.build": "declared_modules",
    "native.toolchain": "find_compiler find_nvcc nvcc_version",
    "rendering.negotiation": "NegotiatedRasterizer",
    "cli.options": "console debug_option json_option options print_json say set_option",
    "cli.complete": "complete_files complete_folders complete_image_folders complete_names complete_nothing",
    "cli.paths": "existing_file output_file output_folder",
    "cli.setup": "Choices",
}
"""Module of the core -> the names that it lends. `tooling.pyi` repeats them for type checkers."""

__all__, __getattr__ = lend(__name__, MODULES)
