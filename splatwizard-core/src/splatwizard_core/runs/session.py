"""What several runs of one command share: plugins, device, loaded scenes and trained models."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from splatwizard_core.errors import NativeBuildError
from splatwizard_core.files import file_sha256
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.native.build import declared_modules, resolve_module
from splatwizard_core.native.loader import cache_root
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.file_digests import FileDigests
from splatwizard_core.runs.identity import scene_digest
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.scene import Scene


@dataclass
class TrainedModel:
    """A finished training: the model, what it was made from, and what is reported of it."""

    model: SplatModel
    key: str
    facts: dict[str, Any]


@dataclass
class Session:
    """One invocation of `sw`.

    device  where models live
    say     takes one-line messages for the user
    """

    plugins: PluginManager
    device: torch.device
    say: Callable[[str], None]
    _scenes: dict[tuple[str, SceneOptions], Scene] = field(default_factory=dict)
    _digests: dict[tuple[str, SceneOptions], str] = field(default_factory=dict)
    _file_digests: dict[Path, str] = field(default_factory=dict)
    _last_trained: TrainedModel | None = None
    _given: TrainedModel | None = None
    _start: TrainedModel | None = None
    _said: set[str] = field(default_factory=set)
    _kernels_loaded: bool = False

    def scene(self, resolved: ResolvedConfig) -> Scene:
        """The scene of a run, loaded once; its warnings are told once."""
        from splatwizard_core.scene.loading import load_scene

        key = (resolved.scene_spec, resolved.scene)
        if key not in self._scenes:
            scene = load_scene(resolved.scene_spec, resolved.scene, self.plugins)
            for warning in scene.warnings:
                self.say(f"scene {scene.name}: {warning}")
            self._scenes[key] = scene
        return self._scenes[key]

    def scene_digest(self, resolved: ResolvedConfig) -> str:
        """What identifies the scene's content, computed once."""
        key = (resolved.scene_spec, resolved.scene)
        if key not in self._digests:
            scene = self.scene(resolved)
            self._digests[key] = scene_digest(scene, FileDigests(_digest_store(scene)))
        return self._digests[key]

    def file_digest(self, path: Path) -> str:
        """SHA-256 of a file, read once."""
        if path not in self._file_digests:
            self._file_digests[path] = file_sha256(path)
        return self._file_digests[path]

    def given(self, path: Path) -> TrainedModel:
        """The explicit Gaussians of a .ply as a trained scene, frozen; read once. Nobody knows how it was trained."""
        from splatwizard_core.runs.start import check_model

        digest = self.file_digest(path)
        if self._given is None or self._given.key != digest:
            model = check_model(str(path)).to(self.device).eval().requires_grad_(False)
            self._given = TrainedModel(model, digest, {"train_s": None, "file": {"name": path.name, "sha256": digest}})
        return self._given

    def say_once(self, line: str) -> None:
        """Tell what rate points and stages would repeat."""
        if line not in self._said:
            self._said.add(line)
            self.say(line)

    def remember_start(self, trained: TrainedModel) -> None:
        """Keep the trained scene that was last started from: often that of the next rate point too."""
        self._start = trained

    def start(self, key: str) -> TrainedModel | None:
        """The trained scene that was last started from, if it is the one asked for."""
        return self._start if self._start is not None and self._start.key == key else None

    def load_kernels(self) -> None:
        """Load (or compile) every installed native module now, so that no clock of a step runs while a compiler does.

        One that cannot be built is told once; whoever needs it falls back or says so.
        """
        if self._kernels_loaded:
            return
        self._kernels_loaded = True
        for target in declared_modules(self.plugins):
            try:
                resolve_module(target).try_load()
            except NativeBuildError as error:
                self.say(f"warning: {error}")

    def remember(self, trained: TrainedModel) -> None:
        """Keep the last trained model: the next rate point often starts from it."""
        self._last_trained = trained

    def trained(self, key: str) -> TrainedModel | None:
        """The last trained model, if it is the one asked for."""
        return self._last_trained if self._last_trained is not None and self._last_trained.key == key else None


def _digest_store(scene: Scene) -> Path | None:
    """Where checksums of a scene's pictures are remembered; None for one that lies nowhere."""
    if scene.path is None:
        return None
    name = hashlib.sha256(str(Path(scene.path).absolute()).encode()).hexdigest()
    return cache_root() / "pictures" / f"{name[:16]}.json"
