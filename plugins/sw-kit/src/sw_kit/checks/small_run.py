"""The small run of a method: train, resume, encode, decode elsewhere, decode again, decode what is damaged."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from splatwizard_core.api import ContainerWriter, Method, Params
from splatwizard_core.tooling import Choices, RunRequest, Session, directory_lock, open_model, run, train_in
from sw_kit.checks.interruptions import stops_of
from sw_kit.checks.prefixes import check_no_cuts, check_prefixes
from sw_kit.checks.targets import make
from sw_kit.finding import BrokenContractError, hold
from sw_kit.samples import TINY
from sw_kit.short_training import file_of

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry, ResolvedConfig

log = logging.getLogger(__name__)

CPU = torch.device("cpu")
STEPS = 40
HOSTILE = 100
"""Number of damaged files that the decoder is shown, unless they take longer than `ENOUGH_S`."""
ENOUGH_S = 12
HOSTILE_S = 600
ASKED, LEAST_FILLED = 0.9, 0.94
"""Size that is asked for, over the plain file's; share of it that is enough for so few Gaussians (of many: 0.97)."""


def check_small_run(entry: Entry, plugins: PluginManager, settings: Sequence[str] = ()) -> str:
    """Hold a method to a whole run on `demo:tiny`: some 40 steps of its full plan, scaled down.

    settings    "KEY=VALUE" besides those that make it short
    """
    resolved = small_configuration(entry, plugins, settings)
    with tempfile.TemporaryDirectory() as folder:
        whole, halved = (RunRequest(resolved, Path(folder) / name) for name in ("whole", "halved"))
        session = Session(plugins, CPU, log.debug)
        record, directory = run(session, whole)
        psnr = record.metrics["psnr"].mean
        hold(psnr is not None and math.isfinite(psnr), f"the PSNR is {psnr}", "the decoded scene cannot be drawn")
        model = train_in(session, whole, directory).model
        stages = list(entry.load()(plugins, resolved.config).stages())
        steps, stops = sum(stage.iterations for stage in stages), stops_of(stages, resolved.ppl, entry)
        resumed, file = "nothing to resume", directory / "scene.swz"
        with _hostile_child(file) as child:  # meanwhile, since it takes as long as the rest
            if stops:
                _check_resume(model.digest(), halved, plugins, stops)
                resumed = f"resumes bit-equal after step {', '.join(map(str, stops))}"
            _check_encoding(entry.load()(plugins, resolved.config), model)
            digests = {open_model(file, plugins, CPU)[0].digest() for _ in range(2)}
            hold(
                digests == {record.file.digest},
                "the file decodes to another model here than in a fresh process",
                "decode() must be a function of the file: no random numbers, no state",
            )
            check_no_cuts(file.read_bytes(), entry)
            prefixes = ""
            if "prefixes" in entry.declared:
                more = [*settings, *filter(None, [entry.declared["prefixes"]])]
                progressive = small_configuration(entry, plugins, more)
                data = file_of(entry.load()(plugins, progressive.config), model)
                prefixes = f"; {check_prefixes(data, lambda reader: entry.load()(plugins, None).decode(reader))}"
            sized = ""
            if {"size"} <= set(resolved.config.ENCODING) & set(type(resolved.config).model_fields):
                wanted = round(ASKED * record.file.bytes)
                asked = small_configuration(entry, plugins, [*settings, f"size={wanted}"])
                method = entry.load()(plugins, asked.config)
                method.scene = session.scene(resolved)
                sized = f"; {check_size(len(file_of(method, model)), wanted)}"
            hostile = _check_hostile(child)
    return f"{steps} steps, {record.file.bytes:,} bytes, {psnr:.1f} dB; {resumed}{prefixes}{sized}; {hostile}"


def check_size(found: int, asked: int) -> str:
    """Hold a file to the size that was asked for: never more, and nearly all of it."""
    hold(
        LEAST_FILLED * asked < found <= asked,
        f"with size={asked:,} its file has {found:,} bytes",
        f"a file of a size has {LEAST_FILLED:.0%} to 100 % of it: `sw_gaussians.sized.fill` writes one",
    )
    return f"a size is filled to {found / asked:.1%}"


def small_configuration(
    entry: Entry, plugins: PluginManager, settings: Sequence[str] = (), rate: str | None = None, steps: int = STEPS
) -> ResolvedConfig:
    """Return the configuration of a short run on `demo:tiny`: every stage has `steps` steps, its plan scaled down.

    rate        rate point; None: the method's default
    """
    stages = make(entry, plugins).stages()
    sets = dict.fromkeys(_lengths(entry.load().Config), steps) | {"scale_schedule": "true"}
    if any(stage.starts_from or stage.taught_by for stage in stages):
        sets["pretrained.iterations"] = steps
    words = (*(f"{key}={value}" for key, value in sets.items()), *settings)
    return Choices((entry.name,), TINY, preset="paper", rate=rate, sets=words, device="cpu").resolve_one(plugins)


def _lengths(config: type[Params], prefix: str = "") -> Iterator[str]:
    """Dotted keys of a configuration that are numbers of steps of a stage: all called `iterations`, or ending so."""
    for name, field in config.model_fields.items():
        if name.endswith("iterations"):
            yield prefix + name
        elif isinstance(field.annotation, type) and issubclass(field.annotation, Params):
            yield from _lengths(field.annotation, f"{prefix}{name}.")


def _check_resume(expected: str, request: RunRequest, plugins: PluginManager, stops: Sequence[int]) -> None:
    """Train again, interrupted after each of `stops` and resumed as by another process; hold it to the same model."""
    directory = request.out / "demo-tiny" / request.resolved.method / request.resolved.rate
    for stop in (*stops, None):
        session = Session(plugins, CPU, log.debug)
        with directory_lock(directory), contextlib.suppress(KeyboardInterrupt):
            found = train_in(session, request, directory, stop_after=stop)
    hold(
        found.model.digest() == expected,
        f"a training that is interrupted after step {', '.join(map(str, stops))} and resumed ends as another model",
        "state lives in parameters, buffers or state_dict_extra; random numbers come from context.generator(name)",
    )


def _check_encoding(method: Method, model: Any) -> None:
    before, files = model.digest(), []
    for _ in range(2):
        writer = ContainerWriter(method.name, method.version)
        with torch.no_grad():
            method.encode(model, writer)
        files.append(writer.to_bytes())
    hold(
        model.digest() == before,
        "encode changes the model",
        "write into clones: encode() gets the model itself, so copy.deepcopy(model) or tensor.detach().clone() first",
    )
    hold(files[0] == files[1], "encoding twice gives two files", "seed what is random in encode()")


@contextlib.contextmanager
def _hostile_child(file: Path) -> Iterator[subprocess.Popen[str]]:
    """Show the decoder damaged files, in a process of its own that may crash or hang; it ends with the block."""
    command = [sys.executable, "-m", "sw_kit.checks.hostile_child", str(file), str(HOSTILE), str(ENOUGH_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        try:
            yield child
        finally:
            child.kill()


def _check_hostile(child: subprocess.Popen[str]) -> str:
    """Hold what that process found to be BitstreamErrors, or legal files."""
    try:
        out, err = child.communicate(timeout=HOSTILE_S)
    except subprocess.TimeoutExpired as error:
        raise BrokenContractError(
            f"{HOSTILE} damaged files take more than {HOSTILE_S} s", "hold counts against reader.allow before a loop"
        ) from error
    if child.returncode != 0:
        raise BrokenContractError(
            f"a damaged file ends the process (status {child.returncode}): {err.strip()[-300:]}",
            "check lengths before native code sees them",
        )
    told: Mapping[str, Any] = json.loads(out.splitlines()[-1])
    hold(
        not told["problems"],
        f"{len(told['problems'])} of {told['shown']} damaged files: {'; '.join(told['problems'][:2])}",
        "decode() raises BitstreamError: read values with reader.integer/number/array, code inside reader.decoding(), "
        "and reader.allow(bytes, what) before allocating",
    )
    others = told["shown"] - told["refused"]
    rest = f", {others} decoded: what was changed there is a legal value or is not used" if others else ""
    return f"{told['refused']} of {told['shown']} damaged files refused{rest}"
