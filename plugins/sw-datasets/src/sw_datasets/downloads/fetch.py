"""Plans which archives are needed for the scenes asked for, and unpacks them under $SPLATWIZARD_DATA."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from splatwizard_core.api import UserInputError, replacing
from splatwizard_core.tooling import write_json
from sw_datasets.downloads.download import Fetched
from sw_datasets.downloads.presence import RECEIPTS, ScenePresence, scene_presence
from sw_datasets.downloads.registry import DataFile, DataSet

DOWNLOADS = ".downloads"
"""Folder under the root where archives lie until they are unpacked, and parts of them until they are whole."""


@dataclass(frozen=True)
class Job:
    """One archive and the purpose it is fetched for: some scenes of a data set, or (no scenes) all that it holds."""

    dataset: DataSet
    file: DataFile
    scenes: tuple[str, ...]

    @property
    def takes_all(self) -> bool:
        """Whether every scene of the archive is wanted."""
        return self.scenes == self.dataset.scenes_of(self.file)

    def target(self, root: Path) -> Path:
        """The folder that the scenes, or the archive's content, go to."""
        home = root / self.dataset.folder
        return home if self.file.into is None else home / self.file.into

    def is_there(self, root: Path) -> bool:
        """Whether what the file brings, where that is no scene, is there already."""
        place = self.target(root)
        return (place / self.file.name if self.file.plain else place).exists()


@dataclass
class Plan:
    """Archives to fetch, and scenes that need none.

    present     scenes or files that are there already
    partly      scenes that are there but lack something; nothing is written over them
    """

    jobs: list[Job] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    partly: list[ScenePresence] = field(default_factory=list)


def plan_fetch(root: Path, registry: Mapping[str, DataSet], targets: Sequence[str]) -> Plan:
    """Plan which archives bring the missing scenes of `targets` (DATASET or DATASET/SCENE).

    Raises UserInputError for unknown names.
    """
    wanted: dict[str, list[str]] = {}
    for target in targets:
        name, slash, scene = target.partition("/")
        dataset = registry[name]
        if slash:
            dataset.check_scene(scene)
        if not dataset.files:
            raise UserInputError(f"nothing is known of where to fetch '{name}' (registry {dataset.registry})")
        wanted.setdefault(name, []).extend([scene] if slash else dataset.scenes)
    plan = Plan()
    for name, scenes in wanted.items():
        dataset = registry[name]
        missing = []
        for scene in dict.fromkeys(scenes):
            found = scene_presence(root, dataset, scene)
            if found.state == "missing":
                missing.append(scene)
            elif found.state == "partly":
                plan.partly.append(found)
            else:
                plan.present.append(f"{name}/{scene}")
        for file in dataset.files:
            held = tuple(scene for scene in dataset.scenes_of(file) if scene in missing)
            job = Job(dataset, file, held)
            if held:
                plan.jobs.append(job)
                missing = [scene for scene in missing if scene not in held]
            elif file.into is not None:
                if job.is_there(root):
                    plan.present.append(f"{name}/{file.name if file.plain else file.into}")
                else:
                    plan.jobs.append(job)
        if missing:
            raise UserInputError(f"no file of '{name}' holds scene '{missing[0]}' (registry {dataset.registry})")
    return plan


def archive_path(root: Path, file: DataFile) -> Path:
    """Path to download an archive to: the same file of two data sets once, equal names of two addresses apart."""
    return root / DOWNLOADS / f"{hashlib.sha256(file.url.encode()).hexdigest()[:8]}-{file.name}"


def unpack_job(root: Path, job: Job, archive: Fetched) -> dict[str, Path]:
    """Unpack the scenes of a job, with receipts; returns scene (or file) name -> where it lies. Raises FetchError."""
    from sw_datasets.downloads.unpack import unpack_scenes, unpack_whole

    if job.file.plain:
        place = job.target(root)
        place.mkdir(parents=True, exist_ok=True)
        with replacing(place / job.file.name) as temporary:
            shutil.copyfile(archive.path, temporary)
        return {job.file.name: place / job.file.name}
    if job.file.into is not None:
        done = {job.file.into: unpack_whole(archive.path, job.target(root))}
    else:
        folders = {scene: job.dataset.folder_names(scene) for scene in job.scenes}
        done = unpack_scenes(archive.path, job.target(root), folders, job.dataset.needs)
    source = {
        "name": job.file.name,
        "url": job.file.url,
        "bytes": archive.bytes,
        "sha256": archive.sha256,
        "verified": archive.verified,
        "unpacked": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    for unpacked in done.values():
        receipts = unpacked.path.parent / RECEIPTS
        receipts.mkdir(exist_ok=True)
        write_json(receipts / f"{unpacked.path.name}.json", {"archive": source, "files": unpacked.files})
    return {name: unpacked.path for name, unpacked in done.items()}
