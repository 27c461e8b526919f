"""The face of the core for packages about runs (reports, sweeps, diagnoses, viewers), besides `api`.

Documented in docs/plugins.md; unlike `api` it is not promised to stay as it is.
"""

from __future__ import annotations

from splatwizard_native import lazy_exports

MODULES = {
    "plugins.manager": "PluginManager load_plugins",
    "plugins.check": "Check State",
    "plugins.registry": "Entry",
    "plugins.loading": "PluginInfo",
    "runs.record": "Record read_record SCHEMA FILE_NAME",
    "base.block": "Shown",
    "training.state": "TrainingState",
    "runs.observers": "FinishedRun FinishedRuns StartedTraining TrainingObserver",
    "base.lock": "directory_lock",
    "runs.config": "ResolvedConfig resolve",
    "runs.identity": "recorded_hash",
    "runs.directory": "OWN_FILES RunRequest run_directory",
    "runs.pretrained": "base_config first_scene make_method named_scenes useful_starts",
    "runs.training": "cached_directory",
    "runs.run": "run train_in",
    "runs.decode": "export_model exporter_of open_model read_gaussians",
    "runs.session": "Session",
    "runs.device": "choose_device",
    "runs.measure": "open_subject",
    "scene.loading": "load_scene",
    "scene.locate": "DATA_VARIABLE",
    "training.pipeline": "TrainingRun TrainingStopped",
    "training.scheduler": "build_schedulers",
    "training.keys": "block_keys",
    "training.params": "SceneParams",
    "base.toml_file": "read_toml",
    "coding.limits": "decoded_limit",
    "evaluation.evaluate": "png_names render_options render_view save_png suggested_rasterizers",
    "evaluation.metrics": "MetricInfo short_reason",
    "errors": "RunLockedError",
    "rendering.negotiation": "NegotiatedRasterizer",
    "cli.options": (
        "config_option console debug_option device_option geometry_option images_option init_option json_option "
        "methods_option options preset_option print_facts print_json print_table rates_option repeats_option say "
        "scene_option seeds_option set_option"
    ),
    "cli.complete": "COMPLETION_VARIABLE SCENE name_of",
    "cli.paths": "EXISTING OUTPUT_FILE OUTPUT_FOLDER existing_file",
    "cli.setup": "Choices open_session takes_choices",
    "plugins.remedies": "as_installed",
}
"""Module of the core -> the names that it lends. `tooling.pyi` repeats them for type checkers."""
BASE = {
    "errors": "ForeseenError",
    "files": "bytes_with_named file_sha256 new_folder write_atomic write_json",
    "progress": "Bar",
}
"""The same of splatwizard-native."""

__all__, __getattr__ = lazy_exports(__name__, MODULES, BASE)
