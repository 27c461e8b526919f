"""Keys of trainings, and the identities in checkpoints of any release, read with the configurations of today.

Equal keys mean an interchangeable model. A key is over the values that differ from the defaults, those of methods that
it is built on too, the version of the method, what the scene holds, and the same of each trained scene that it starts
from. A checkpoint holds all values instead, defaults too: so a training of another release is known by its values,
whatever has become of keys and defaults since.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.method import Method
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import ResolvedConfig, content_hash
from splatwizard_core.runs.pretrained import base_config, first_scene, make_method, named_scenes
from splatwizard_core.runs.record import Record
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.training.identity import given_values
from splatwizard_core.training.keys import dotted, flatten, set_at
from splatwizard_core.training.params import PipelineParams, SceneParams

FORMAT = 3  # raised when checkpoints come to say something else of what they were made from
ALL_VALUES = 3  # first format with all values; those before left out keys that were at their defaults
FORMER_SCENE = {"principal_point": "center", "mask_background": False}
"""Options of reading a scene -> their defaults until 0.2; what they come to stands in the protocol, which counts."""
KEY = "key"  # of the training, as the release that made it had it
_NOT_OF_TODAY = (SplatwizardError, ValidationError, KeyError, TypeError, ValueError)
BEFORE, BORROWED = "starts from", "built on"
_PARTS = {"method", "config", "pipeline", "scene", "method_version", BEFORE, BORROWED}


def training_key(session: Session, resolved: ResolvedConfig) -> str:
    """Return the key of everything a training is made from: equal keys mean an interchangeable model."""
    content = _content(session, resolved, all_values=False)
    return content_hash([FORMAT, {**content, "scene content": session.scene_digest(resolved)}])


def training_identity(session: Session, resolved: ResolvedConfig) -> dict[str, Any]:
    """Return what a checkpoint of this training says that it was made from: all values, and its key."""
    return {
        **_content(session, resolved, all_values=True),
        "scene content": session.scene_digest(resolved),
        "identity": FORMAT,
        KEY: training_key(session, resolved),
    }


def _content(session: Session, resolved: ResolvedConfig, *, all_values: bool) -> dict[str, Any]:
    """Return what a training and the scenes before it depend on; all values, or those that are given."""
    before: dict[str, Any] = {}
    method = make_method(session.plugins, resolved)
    for name in named_scenes(method):
        if resolved.init and name == first_scene(method):
            before[name] = {"file": f"sha256 {session.file_digest(Path(resolved.init))}"}
        else:
            before[name] = _content(session, base_config(session.plugins, name, resolved), all_values=all_values)
    content = _values(resolved, all_values=all_values)
    named = _named({BORROWED: _borrowed(method), BEFORE: before})
    return {**content, "method_version": type(method).version, **named}


def _values(resolved: ResolvedConfig, *, all_values: bool) -> dict[str, Any]:
    if all_values:
        return resolved.training_values()
    content = resolved.training_content()
    return {**content, "scene": {k: v for k, v in content["scene"].items() if k not in FORMER_SCENE}}


def _borrowed(method: Method) -> dict[str, Any]:
    """Return the given values of the methods that the stages are built on, and of those that these are built on."""
    return {
        other.name: {"config": given_values(other.config, other.plugins), **_named({BORROWED: _borrowed(other)})}
        for other in method.borrows()
    }


def _named(blocks: Mapping[str, Any]) -> dict[str, Any]:
    return {name: block for name, block in blocks.items() if block}


def stored_config(plugins: PluginManager, stored: Mapping[str, Any], *, absent: bool = False) -> ResolvedConfig:
    """Return the configuration of which a checkpoint or a record holds the values, with the keys of today.

    absent      it is of a release that left out keys: they get the values of `ABSENT`, else the defaults

    Raises SplatwizardError or ValueError if today's method cannot have these values.
    """
    cls = plugins.methods.load(stored["method"])
    config, ppl, scene = cls.Config(), stored["pipeline"], dict(stored["scene"])
    if absent:
        scene = {key: value for key, value in scene.items() if key not in FORMER_SCENE or value != FORMER_SCENE[key]}
    values = {**(cls.Config.ABSENT if absent else {}), **flatten(cls.Config, stored["config"])}
    values = dict(config.spelled(values))
    content = config.model_dump()
    for key, value in values.items():
        set_at(content, key, value)
    config = cls.Config.model_validate(content).completed(plugins, dict.fromkeys(values, "a stored training"))
    run = PipelineParams.model_validate(ppl)
    options = SceneOptions(**SceneParams.model_validate(scene).model_dump(), seed=run.seed)
    return ResolvedConfig(
        cls.name, stored.get("preset", "paper"), stored.get("rate", cls.DEFAULT_RATE), "", config, run, options,
        given_values(config, plugins), {}, stored.get("init", ""), dotted(stored.get("pretrained", {})),
    )  # fmt: skip


def stored_beside(plugins: PluginManager, stored: Mapping[str, Any], identity: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a checkpoint of any release says, such that it differs from this training's `identity` where they do.

    The identity itself for the same training; else the stored values by the keys of today, or as they are where
    today's method cannot have them.
    """
    if stored_key(plugins, stored) == identity[KEY]:
        return identity
    try:
        values = _today(plugins, stored, _is_partial(stored), all_values=True)
    except _NOT_OF_TODAY:
        values = dict(stored)
    return {**values, "identity": FORMAT, KEY: identity[KEY]}


def stored_key(plugins: PluginManager, stored: Mapping[str, Any], *, finished_as: str | None = None) -> str | None:
    """Return the key that the training in a checkpoint has today; None where today's method cannot have its values.

    finished_as     key under which the steps beside it are finished: None too where it is of another training
    """
    try:
        if finished_as is not None and key_when_made(stored) != finished_as:
            return None
        content = _today(plugins, stored, _is_partial(stored), all_values=False)
        content["scene content"] = stored["scene content"]
    except _NOT_OF_TODAY:
        return None
    return content_hash([FORMAT, content])


def recorded_hash(plugins: PluginManager, record: Record) -> str | None:
    """Return the `config_hash` that the configuration of a record has today; None where there can be none."""
    try:
        return stored_config(plugins, record.config or {}, absent=True).config_hash()
    except _NOT_OF_TODAY:
        return None


def key_when_made(stored: Mapping[str, Any]) -> str:
    """Return the key that a training had when it was made, from what its checkpoint says of it.

    Until format 2 it was over the values that were told there, with a hash of the configuration inside.
    """
    if not _is_partial(stored):
        return str(stored.get(KEY))
    told = content_hash({k: stored[k] for k in ("method", "config", "pipeline", "scene")})
    parts = [stored["identity"], told, stored["scene content"], stored["method"], stored["method_version"]]
    return content_hash([*parts, stored[BEFORE]] if BEFORE in stored else parts)


def _is_partial(stored: Mapping[str, Any]) -> bool:
    return int(stored.get("identity", 0)) < ALL_VALUES


def _today(plugins: PluginManager, stored: Mapping[str, Any], partial: bool, *, all_values: bool) -> dict[str, Any]:
    """Return the stored content of a training with the keys of today; what is no configuration stays as it is."""
    if "file" in stored:
        return dict(stored)
    resolved = stored_config(plugins, stored, absent=partial)
    content = _values(resolved, all_values=all_values)
    before = {
        name: _today(plugins, inner, partial, all_values=all_values) for name, inner in stored.get(BEFORE, {}).items()
    }
    # Until format 2 it does not tell what it was built on, which follows from its values.
    borrowed = _borrowed(make_method(plugins, resolved)) if partial else stored.get(BORROWED, {})
    beside = {k: v for k, v in stored.items() if k not in _PARTS and all_values}
    version = {"method_version": stored["method_version"]}
    return {**beside, **content, **version, **_named({BORROWED: borrowed, BEFORE: before})}
