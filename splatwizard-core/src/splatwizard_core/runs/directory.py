"""A run directory: its place, its files, and the log of the steps that are finished in it."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from splatwizard_core.base.block import Block
from splatwizard_core.base.files import remove_folder, sweep, write_atomic, write_json
from splatwizard_core.base.lock import directory_lock
from splatwizard_core.errors import SceneError
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.record import FILE_NAME
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.images import check_pictures, decode_all

FactsT = TypeVar("FactsT", bound=Block)

STEPS = "steps.json"
CHECKPOINTS = "checkpoints"
CONFIG = "config.toml"
LOG = "log.jsonl"
ENCODED = "scene.swz"
RENDERS = "renders"
# A file that says that something is finished goes first when a directory is cleared.
OWN_FILES = (STEPS, FILE_NAME, CHECKPOINTS, CONFIG, LOG, ENCODED, RENDERS, "truth", "scene.html", "report.html")


@dataclass(frozen=True)
class RunRequest:
    """One run that is asked for.

    out         root of all run directories
    resume      use the finished steps and checkpoints that are there; False: discard them
    allow_changed_plan  resume although the plan or configuration differs from the checkpoint's
    repeats     how often rendering speed is measured; decoding is timed as often, and at least three times
    geometry    measure the model's geometry too
    """

    resolved: ResolvedConfig
    out: Path
    resume: bool = True
    allow_changed_plan: bool = False
    repeats: int = 1
    geometry: bool = False


class StepLog:
    """The finished steps of a run directory, each with the key of its inputs and the facts that came out.

    A step counts as done only under the same key, so that changed inputs do it again.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / STEPS

    def _read(self) -> dict[str, Any]:
        try:
            content = json.loads(self.path.read_text())
        except (OSError, ValueError):
            return {}  # none yet, or damaged: then the steps are done again
        if not isinstance(content, dict):
            return {}
        return {k: v for k, v in content.items() if isinstance(v, dict) and {"key", "facts"} <= set(v)}

    def done(self, step: str, key: str, kind: type[FactsT]) -> FactsT | None:
        """Return the facts of a finished step, or None if it was not done from these inputs."""
        found = self._read().get(step)
        with contextlib.suppress(ValidationError):  # damaged: it is done again
            return kind.model_validate(found["facts"]) if found is not None and found["key"] == key else None
        return None

    def key_of(self, step: str) -> str | None:
        """Return the key of the inputs that a step was finished from; None if it was not."""
        found = self._read().get(step)
        return None if found is None else str(found["key"])

    def finish(self, step: str, key: str, facts: Block) -> None:
        """Remember a finished step."""
        write_json(self.path, {**self._read(), step: {"key": key, "facts": facts.model_dump(mode="json")}})

    def once(
        self,
        step: str,
        key: str,
        do: Callable[[], FactsT],
        kind: type[FactsT],
        *,
        holds: Callable[[FactsT], bool] = lambda facts: True,
    ) -> FactsT:
        """Return the facts of a step as they are remembered; where they are not, do it and remember its facts.

        holds   facts of the same inputs -> they still hold what is asked for
        """
        facts = self.done(step, key, kind)
        if facts is None or not holds(facts):
            facts = do()
            self.finish(step, key, facts)
        return facts


def run_directory(request: RunRequest) -> Path:
    """Return out/<scene>/<method>/<rate>. Raises SceneError for a scene whose folder's name is not UTF-8."""
    resolved = request.resolved
    scene = resolved.absolute_scene
    try:
        scene.encode()  # config.toml and the record name it
    except UnicodeEncodeError:
        shown = os.fsencode(scene).decode(errors="replace")
        raise SceneError(
            f"scene '{shown}': the name of its folder, or the locale, is not UTF-8: rename it, or set LC_ALL=C.UTF-8",
            path=shown,
        ) from None
    return request.out / Path(scene).name.replace(":", "-") / resolved.method / resolved.rate


@contextlib.contextmanager
def held_directory(session: Session, request: RunRequest) -> Iterator[Path]:
    """Hold the directory of a run, cleared where the run starts again; before that load the scene, and check pictures.

    What a killed process left half written is cleared too; other files in the directory stay.
    """
    directory = run_directory(request)
    scene = session.scene(request.resolved)
    if not directory.exists() or not request.resume:
        decode_all(scene.train)  # training reads them anyway, and they stay
        check_pictures(scene.test)
    with directory_lock(directory, say=session.say):
        own = [directory / name for name in OWN_FILES]
        for folder in (directory, *(path for path in own if path.is_dir())):
            sweep(folder)
        for path in () if request.resume else own:
            if path.is_dir() and not path.is_symlink():
                remove_folder(path)
            else:
                path.unlink(missing_ok=True)
        if not (directory / CONFIG).exists():
            write_config(directory, request.resolved)
        yield directory


def write_config(directory: Path, resolved: ResolvedConfig) -> None:
    """Write config.toml, which repeats the run. A changed one replaces it only once its training is accepted."""
    write_atomic(directory / CONFIG, resolved.toml())
