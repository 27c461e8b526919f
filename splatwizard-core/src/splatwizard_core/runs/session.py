"""Plugins, device, loaded scenes and trained models that several runs of one command share."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch

from splatwizard_core.base.files import file_sha256
from splatwizard_core.errors import SceneError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.catalogue import package_of
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.facts import TrainingFacts
from splatwizard_core.scene.digest import scene_digest
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.scene.scene import Scene

T = TypeVar("T")
Role = Literal["trained", "start"]
"""Of a model that a session keeps: trained last, or started from last."""


@dataclass
class TrainedModel:
    """A finished training: the model, the key of what it was made from, and the facts that are reported of it."""

    model: SplatModel
    key: str
    facts: TrainingFacts


@dataclass
class Session:
    """One invocation of `sw`.

    device  where models live
    say     takes one-line messages for the user
    told    warnings of scenes that were said, which another process for the same run need not repeat
    """

    plugins: PluginManager
    device: torch.device
    say: Callable[[str], None]
    told: list[str] = field(default_factory=list)
    _made: dict[Hashable, Any] = field(default_factory=dict)
    _models: dict[Role, TrainedModel] = field(default_factory=dict)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return what `make` made when the key first came."""
        if key not in self._made:
            self._made[key] = make()
        found: T = self._made[key]
        return found

    def scene(self, resolved: ResolvedConfig) -> Scene:
        """Return the scene of a run, loaded once; its warnings are told once, those about values that stand in the
        config.toml of a run when it was made."""

        def load() -> Scene:
            if not resolved.scene_spec:
                package = package_of("default", "dataset") or "'splatwizard-core[all]'"
                raise SceneError(f"no scene is named, and the default one is not there: pip install {package}")
            scene = load_scene(resolved.scene_spec, resolved.scene, self.plugins)
            for warning in scene.warnings:
                line = f"scene {scene.name}: {warning}"
                self.told.append(line)
                if not resolved.is_of_run(warning.partition(" ")[0]):
                    self.say(line)
            return scene

        return self.once(("scene", resolved.scene_spec, resolved.scene), load)

    def scene_digest(self, resolved: ResolvedConfig) -> str:
        """Return the checksum of the scene's content, computed once."""
        key = ("digest", resolved.scene_spec, resolved.scene)
        return self.once(key, lambda: scene_digest(self.scene(resolved)))

    def file_digest(self, path: Path) -> str:
        """Return the SHA-256 of a file, read once."""
        return self.once(path, lambda: file_sha256(path))

    def say_once(self, line: str) -> None:
        """Tell what rate points and stages would repeat."""
        self.once(line, lambda: self.say(line))

    def rasterizer(self, resolved: ResolvedConfig, suggested: Iterable[str]) -> NegotiatedRasterizer:
        """Return what draws for a run: the user's choice first, then `suggested` names; with the user's options."""
        chosen = resolved.ppl.raster
        return NegotiatedRasterizer(
            self.plugins, device=self.device, prefer=chosen.prefer, forbid=chosen.forbid, suggested=suggested,
            options=chosen.options,
        )  # fmt: skip

    def keep(self, role: Role, model: TrainedModel) -> None:
        """Keep one model of each role: the next rate point often wants it again."""
        self._models[role] = model

    def kept(self, role: Role, key: str) -> TrainedModel | None:
        """Return the kept model of a role if it was made from what `key` stands for."""
        found = self._models.get(role)
        return found if found is not None and found.key == key else None
