"""The process that trains what several runs of a sweep start from."""

from __future__ import annotations

from pathlib import Path

from splatwizard_core.tooling import (
    Choices,
    RunRequest,
    cached_directory,
    directory_lock,
    load_plugins,
    open_session,
    train_in,
    write_json,
)


def train_shared(file: Path, root: Path) -> None:
    """Train the configuration of `file` into the trained scenes of `root`, and note beside the file where it lies.

    A run under that root, or one that starts from such a scene, finds it there.
    """
    plugins = load_plugins()
    resolved = Choices(config_file=str(file)).resolve_one(plugins)
    session = open_session(resolved, plugins)
    directory = cached_directory(session, resolved, root)
    with directory_lock(directory, wait=True, say=session.say):
        train_in(session, RunRequest(resolved, root), directory)
    write_json(file.with_suffix(".json"), {"directory": str(directory.resolve())})
