"""Encode a trained model into one file: from a run directory, or from a .ply."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch

from splatwizard_core.base.files import file_sha256
from splatwizard_core.base.lock import directory_lock
from splatwizard_core.base.memory import synchronize
from splatwizard_core.base.random_states import one_order_of_sums
from splatwizard_core.coding.container import ContainerWriter
from splatwizard_core.coding.requirements import Requirement
from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.evaluation.evaluate import kept_header
from splatwizard_core.gaussians.model import Origin
from splatwizard_core.gaussians.placement import NOWHERE
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.method import Method
from splatwizard_core.plugins import Entry
from splatwizard_core.plugins.catalogue import CORE
from splatwizard_core.plugins.versions import made_by
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.decode import read_gaussians
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.facts import EncodingFacts, contention
from splatwizard_core.runs.phases import part_of, unique
from splatwizard_core.runs.pretrained import make_method
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.training import finished_directory, train
from splatwizard_native import CoreTime, work_time

NEEDED_KINDS = ("method", "quantizer", "entropy model", "context model", "coder")
"""Kinds that a decoder may want again; a pruner or a rasterizer has done its work by then."""


def encode(
    method: Method, model: SplatModel, raster: dict[str, Any], path: Path, origin: Origin = NOWHERE, *,
    deterministic: bool = False,
) -> EncodingFacts:  # fmt: skip
    """Write one file; returns the facts of the encoding, for the record and for what is done again later.

    raster          what the header asks of a rasterizer
    origin          where the origin of the model's coordinates lies in the world
    deterministic   equal models give equal bytes on CUDA too: a method may train codebooks here

    The clock runs from the trained model to the closed file. Raises SplatwizardError if the method changes the model.
    """
    before = model.digest()
    synchronize(model.device)
    cores, began = CoreTime(), work_time()
    with one_order_of_sums() if deterministic else contextlib.nullcontext():
        writer, loaded = filled_writer(method, model, raster, origin)
    size = writer.write(path)
    synchronize(model.device)
    seconds, contended = work_time() - began, contention("encode", cores)
    if model.digest() != before:
        raise SplatwizardError(f"method '{method.name}' changed the model while encoding it, which it may not")
    return EncodingFacts(
        encode_s=seconds,
        float32_bytes=4 * sum(values.numel() for values in model.parameters()),
        contended=contended,
        bytes=size,
        sha256=file_sha256(path),
        made_by=made_by(method.plugins, loaded),
        parts=unique(part_of(entry) for entry in loaded),
    )


def filled_writer(
    method: Method, model: SplatModel, raster: dict[str, Any], origin: Origin = NOWHERE
) -> tuple[ContainerWriter, list[Entry]]:
    """Return what `encode` writes, and the entries that were asked for."""
    writer = ContainerWriter(method.name, method.version, raster=raster)
    with torch.no_grad(), method.plugins.recording() as loaded:
        method.encode(model, writer)
    if any(origin):
        writer.world_origin = origin
    loaded += [method.plugins.registries[kind].entry(name) for kind, name in writer.required]
    if method.name in method.plugins.methods:
        loaded.insert(0, method.plugins.methods.entry(method.name))
    writer.requires = requirements(loaded)
    return writer, loaded


def requirements(entries: Iterable[Entry]) -> list[Requirement]:
    """List what a reader needs for a file that these entries wrote: the core first, each distribution once."""
    versions = {CORE: importlib.metadata.version(CORE)}
    provided: dict[str, dict[tuple[str, str], None]] = {CORE: {}}
    for entry in entries:
        if entry.distribution and entry.version and entry.kind in NEEDED_KINDS:
            versions[entry.distribution] = entry.version
            provided.setdefault(entry.distribution, {})[entry.kind, entry.name] = None
    # A local version (1.0+cpu) is no lower bound that pip takes.
    found = [Requirement(name, versions[name].partition("+")[0], tuple(pairs)) for name, pairs in provided.items()]
    return [each for each in found if each.is_well_formed]  # it is advice: an odd name must not spoil the file


@contextlib.contextmanager
def finished_training(session: Session, resolved: ResolvedConfig, directory: Path) -> Iterator[TrainedModel]:
    """Load the finished training of a run directory, and hold it. Raises UserInputError if it is not finished."""
    parents = directory.resolve().parents
    request = RunRequest(resolved, parents[min(2, len(parents) - 1)])  # OUT/<scene>/<method>/<rate>
    if finished_directory(session, request, directory) is None:
        raise UserInputError(
            f"{directory} holds no finished training of this configuration: `sw train --config "
            f"{directory}/config.toml` makes it (only keys of the file, such as `codec`, may differ)"
        )
    with directory_lock(directory, say=session.say):
        yield train(session, request, directory)


def encode_directory(session: Session, resolved: ResolvedConfig, directory: Path, target: Path) -> EncodingFacts:
    """Encode the finished training of a run directory. Raises UserInputError if it is not finished."""
    with finished_training(session, resolved, directory) as trained:
        return encode_trained(session, resolved, trained, target)


def encode_trained(session: Session, resolved: ResolvedConfig, trained: TrainedModel, target: Path) -> EncodingFacts:
    """Encode a model that was trained on the scene of a configuration."""
    method, scene = make_method(session.plugins, resolved), session.scene(resolved)
    method.scene, raster = scene, trained.facts.raster
    return encode(method, trained.model, raster, target, scene.origin, deterministic=resolved.ppl.deterministic)


def encode_ply(session: Session, resolved: ResolvedConfig, path: Path, target: Path) -> EncodingFacts:
    """Encode the explicit Gaussians of a .ply. Raises UserInputError for methods that do not encode such."""
    if session.plugins.importers.of_suffix(path) is None:
        raise UserInputError(f"{path}: `sw encode` takes a run directory or a .ply")
    model = read_gaussians(path, session.plugins).to(session.device).eval().requires_grad_(False)
    method = make_method(session.plugins, resolved)
    last = list(method.stages())[-1]
    raster = kept_header(model, last.raster_options(last.iterations, torch.zeros(3)), resolved.ppl.raster.options)
    try:
        origin = getattr(model, "world_origin", None) or NOWHERE
        return encode(method, model, raster, target, origin, deterministic=resolved.ppl.deterministic)
    except (TypeError, AttributeError) as error:
        raise UserInputError(f"method '{method.name}' does not encode a .ply of explicit Gaussians: {error}") from error
