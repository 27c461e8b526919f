"""Decode a model from a file and nothing else: by the method that its header names, timed by the protocol."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

import torch

from splatwizard_core.base.files import replacing
from splatwizard_core.base.memory import MemoryMeter, synchronize
from splatwizard_core.base.progress import track
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.cuts import WHOLE, Prefix
from splatwizard_core.errors import BitstreamError, PluginError, SplatwizardError, UserInputError
from splatwizard_core.evaluation.speed import spread
from splatwizard_core.gaussians.invalid_rows import leave_out_senseless
from splatwizard_core.gaussians.model import GaussianModel, as_origin
from splatwizard_core.gaussians.placement import NOWHERE, with_origin
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.method import Method
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.facts import DecodingFacts, contention
from splatwizard_core.runs.file_needs import missing_plugin, other_versions, upgrade_command
from splatwizard_core.runs.session import Session
from splatwizard_native import CoreTime, loading_time, work_time

REPEATS = 3


def read_gaussians(path: Path, plugins: PluginManager) -> GaussianModel:
    """Return the explicit Gaussians of a file of another format, without the rows that mean nothing."""
    return leave_out_senseless(plugins.read_gaussians(path), path.name)


def open_model(
    path: str | Path, plugins: PluginManager, device: torch.device, *, tell: bool = True, prefix: Prefix = WHOLE
) -> tuple[SplatModel, ContainerReader]:
    """Return the decoded model, ready to render on `device`, and the file it came from.

    tell    log what was left out of it
    prefix  how much of a file with cuts is read

    Raises BitstreamError for a damaged file, PluginError if something that it needs is not installed.
    """
    reader = ContainerReader.open(path, prefix)
    model = decode_model(reader, plugins).to(device).eval().requires_grad_(False)
    if isinstance(model, GaussianModel):
        model = leave_out_senseless(model, reader.name, tell=tell)
    with_origin(model, as_origin(reader.world_origin) or NOWHERE)
    model.origin = {**model.origin, "raster": reader.raster, "file": str(path)}
    return model, reader


def decode_model(reader: ContainerReader, plugins: PluginManager) -> SplatModel:
    """Return the model in a parsed file, on the CPU. Raises as `open_model`."""
    method_class = _method_of(reader, plugins)
    if reader.version > method_class.version:
        entry = plugins.methods.entry(reader.method)
        raise BitstreamError(
            f"{reader.name}: version {reader.version} of the layout of '{reader.method}' is newer than "
            f"{method_class.version}, which {entry.distribution} {entry.version} reads: upgrade with "
            f"{upgrade_command(reader, entry.distribution, entry.version, entry.name)}"
        )
    try:
        with torch.no_grad():
            model = method_class(plugins, None).decode(reader)
        reader.finish()
    except PluginError as error:
        # Asked for only now: what helped to write the file may have nothing to do with reading it.
        if error.kind is None or error.name is None:
            raise
        if error.name in plugins.registries.get(error.kind, ()):  # it is there, and of no use in this place
            raise BitstreamError(str(error), section="header") from error
        raise missing_plugin(reader, plugins, error.kind, error.name) from error
    except BitstreamError as error:
        raise BitstreamError(f"{error}{other_versions(reader, plugins)}", section=error.section) from error
    return model


def import_method(path: str | Path, plugins: PluginManager, prefix: Prefix = WHOLE) -> None:
    """Import the method that a file names, so that its code counts neither as memory nor as time of what follows."""
    _method_of(ContainerReader.open(path, prefix), plugins)


def _method_of(reader: ContainerReader, plugins: PluginManager) -> type[Method]:
    """Return the class of the method that wrote a file. Raises PluginError that says what to install."""
    name, methods = reader.method, plugins.methods
    if name in methods or name in methods.clashes:
        return methods.load(name)
    raise missing_plugin(reader, plugins, "method", name)


def timed_decode(
    path: Path, session: Session, *, repeats: int = REPEATS, prefix: Prefix = WHOLE
) -> tuple[SplatModel, DecodingFacts]:
    """Decode once untimed and `repeats` times timed, after every native module was loaded or compiled, timed apart.

    Raises SplatwizardError if two decodes give different models.
    """
    device = session.device

    def once(*, tell: bool = False) -> tuple[SplatModel, ContainerReader, float]:
        synchronize(device)
        began = work_time()
        model, reader = open_model(path, session.plugins, device, tell=tell, prefix=prefix)
        synchronize(device)
        return model, reader, work_time() - began

    import_method(path, session.plugins, prefix)
    meter = MemoryMeter(device)
    meter.start()
    with track(f"decode {path.name}", total=1 + repeats) as bar:
        model, reader, first = once(tell=True)
        peak = meter.peak_bytes()
        digest = model.digest()
        bar.advance()
        runs: list[float] = []
        cores = CoreTime()
        for _ in range(repeats):
            del model
            model, reader, seconds = once()
            runs.append(seconds)
            bar.advance()
        contended = contention("decode", cores)
    if model.digest() != digest:
        raise SplatwizardError(
            f"{path}: two decodes give different models; method '{reader.method}' is not deterministic"
        )
    return model, DecodingFacts(
        method=reader.method, method_version=reader.version, digest=digest, counts=model.counts(), bytes=reader.size,
        packets=reader.packets, sections={"header": reader.header_bytes, **reader.sections}, raster=reader.raster,
        decode_s=statistics.median(runs) if runs else first, decode_runs_s=runs,
        decode_spread=spread(runs) if len(runs) > 1 else None, first_decode_s=first, jit_s=loading_time(),
        contended=contended, peak_bytes=peak, memory_kind=meter.kind, device=str(device),
    )  # fmt: skip


def save_decoded(model: SplatModel, facts: DecodingFacts, path: Path, plugins: PluginManager) -> None:
    """Keep a decoded model: `.safetensors` holds its tensors and says what they are, any other suffix is an exporter's.

    Raises UserInputError if no exporter writes such files.
    """
    if path.suffix != ".safetensors":
        export_model(model, path, plugins)
        return
    from safetensors.torch import save_file

    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    told = {"method": facts.method, "digest": facts.digest, "extra": json.dumps(model.state_dict_extra())}
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata=told)


def exporter_of(path: Path, plugins: PluginManager, name: str | None = None) -> str:
    """Return the exporter `name`; None: the one whose declared suffix `path` has. Raises UserInputError without it."""
    name = plugins.exporters.of_suffix(path) if name is None else plugins.exporters.entry(name).name
    if name is None:
        known = ", ".join(f"{s} ({e.name})" for e in plugins.exporters if (s := e.declared.get("suffix")))
        hint = "; `sw compress` writes .swz" if path.suffix == ".swz" else ""
        raise UserInputError(f"no installed exporter writes '{path.suffix}' files ({path}); there are: {known}{hint}")
    return name


def export_model(model: SplatModel, path: Path, plugins: PluginManager, name: str | None = None) -> str:
    """Write an interchange format; returns the name of the exporter, that of `exporter_of`.

    Raises UserInputError if there is none, or if the model has no such form, PluginError if the exporter breaks.
    """
    name = exporter_of(path, plugins, name)
    with plugins.guarding(plugins.exporters, name):
        plugins.exporters.load(name)(model, path)
        if not path.exists():
            raise RuntimeError(f"it wrote no {path}")
    return name
