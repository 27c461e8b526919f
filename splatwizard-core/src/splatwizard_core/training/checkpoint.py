"""Checkpoints: a safetensors file of all tensors and a JSON file of everything else, written as a pair. No pickle.

`00-0001000.safetensors` + `00-0001000.json`: stage 0 after step 1000. Both carry the same random pair id. The JSON file
is renamed into place last, which makes the pair valid. It names the other file and holds a CRC-32 of itself and of
every tensor. If a step is written again, its tensors get a new name, so the old pair stays valid until then.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import json
import logging
import os
import re
import secrets
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from splatwizard_core.base.block import Block
from splatwizard_core.base.files import TEMPORARY, replacing
from splatwizard_core.errors import CheckpointError
from splatwizard_core.training.keys import dotted
from splatwizard_core.training.measurements import TrainingFigures

T = TypeVar("T")
log = logging.getLogger(__name__)

FORMAT = 1
TENSOR_KEY = "$tensor"
SHOWN_CHARACTERS = 40  # of a value that differs
_JSON = re.compile(r"\d{2}-\d{7,}\.json")
_TENSORS = re.compile(r"\d{2}-\d{7,}(-[0-9a-f]{8})?\.safetensors")
_OURS = re.compile(rf"\.?({_JSON.pattern}|{_TENSORS.pattern})({TEMPORARY}|\.damaged)?")


class DamagedCheckpointError(CheckpointError):
    """The pair of files is damaged; an older pair may be intact."""


class Checkpoint(Block, strict=True, frozen=False):
    """State of a run after one step.

    stage, stage_name, step     where it stands; steps count from 1 in each stage
    finished    the stage is over (its last step, or a task stopped it)
    identity    what the result depends on besides the plan: method, version, resolved configuration (JSON-able)
    plan        `plan_lines` of the stage's tasks
    extent      scene extent E, world units
    progress    figures of the training up to here
    state       nested dicts and lists of tensors and JSON-able values
    """

    stage: int = Field(ge=0)
    stage_name: str
    step: int = Field(ge=0)
    finished: bool
    identity: dict[str, Any]
    plan: list[str]
    extent: float
    progress: TrainingFigures
    state: dict[str, Any] = Field(exclude=True)


class CheckpointStore:
    """The checkpoints of one run in one directory.

    keep    how many of the newest of a stage stay; the last one of each finished stage stays too, since a later
            stage is resumed on top of it
    """

    def __init__(self, directory: Path, keep: int = 1) -> None:
        self.directory, self.keep = directory, keep

    def write(self, checkpoint: Checkpoint) -> Path:
        """Write the pair atomically, then delete outdated ones; return the JSON file's path."""
        self.directory.mkdir(parents=True, exist_ok=True)
        tensors: dict[str, Tensor] = {}
        pair = secrets.token_hex(16)
        path = self.directory / f"{checkpoint.stage:02d}-{checkpoint.step:07d}.json"
        tensor_path = path.with_suffix(".safetensors")
        if path.exists():
            tensor_path = path.with_name(f"{path.stem}-{pair[:8]}.safetensors")
        content = {
            **checkpoint.model_dump(mode="json"),
            "format": FORMAT,
            "pair": pair,
            "file": tensor_path.name,
            "state": split_tensors(checkpoint.state, tensors),
            "tensors": {name: _crc(tensor) for name, tensor in tensors.items()},
        }
        body = json.dumps(content)
        text = json.dumps({"crc": zlib.crc32(body.encode()), "content": content})
        size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
        # On the disk itself, since the one before goes. The inner file takes its place first: the JSON file makes the
        # pair valid.
        try:
            with (
                replacing(path, wanted=len(text), durable=True) as beside,
                replacing(tensor_path, wanted=size, durable=True) as tensors_beside,
            ):
                save_file(tensors, tensors_beside, {"pair": pair})
                beside.write_text(text)
        except BaseException:
            if _content(path).get("pair") != pair:  # a Ctrl-C may have come when all was done
                tensor_path.unlink(missing_ok=True)
            raise
        self._prune(checkpoint.stage)
        return path

    def paths(self) -> list[Path]:
        """The JSON files, newest first."""
        found = (p for p in self.directory.glob("*.json") if _JSON.fullmatch(p.name))
        # By number: names of steps past 9,999,999 are longer.
        return sorted(found, key=lambda p: tuple(map(int, p.stem.split("-"))), reverse=True)

    def restored(self, use: Callable[[Checkpoint], T]) -> T | None:
        """Return what `use` makes of the newest checkpoint that can be read and used, or None if there is none.

        Damaged ones, with which reading or `use` raises DamagedCheckpointError, are set aside with a warning; raises
        CheckpointError if all of them are damaged, and then leaves them where they are.
        """
        problems: dict[Path, CheckpointError] = {}
        for path in self.paths():
            try:
                found = use(read_checkpoint(path))
            except DamagedCheckpointError as error:
                problems[path] = error
                continue
            for damaged, problem in problems.items():
                log.warning("%s; resuming from %s instead", problem, path.name)
                for each in (damaged, *self.directory.glob(f"{damaged.stem}*.safetensors")):
                    with contextlib.suppress(OSError):
                        os.replace(each, each.with_name(f"{each.name}.damaged"))
            return found
        for problem in problems.values():
            raise CheckpointError(f"{problem}; no earlier checkpoint is left, so start again (--fresh)")
        return None

    def last_of(self, stage: int) -> Checkpoint:
        """Return the checkpoint that finished a stage. Raises CheckpointError."""
        for path in self.paths():
            if path.name.startswith(f"{stage:02d}-") and (found := read_checkpoint(path)).finished:
                return found
        raise CheckpointError(
            f"{self.directory}: the last checkpoint of stage {stage} is missing; start again (--fresh)"
        )

    def identity(self) -> dict[str, Any] | None:
        """Return the identity in the newest checkpoint; None if there is none, or none that can be read."""
        return next((_content(path).get("identity") for path in self.paths()), None)

    def clear(self) -> None:
        """Remove every checkpoint file of the directory, unfinished ones included."""
        # What makes a pair valid goes first: a process that ends here leaves no half of one.
        for path in sorted(self.directory.glob("*"), key=lambda p: p.suffix != ".json"):
            if _OURS.fullmatch(path.name):
                path.unlink()

    def _prune(self, stage: int) -> None:
        """Delete checkpoints made obsolete by a new one of `stage`."""
        kept = set()
        for number, paths in itertools.groupby(self.paths(), key=lambda path: int(path.name[:2])):
            for path in itertools.islice(paths, self.keep if number == stage else 1):
                kept |= {path.name, _content(path).get("file", f"{path.stem}.safetensors")}
        for path in self.directory.iterdir():
            # Also what a killed process left half written; what was set aside as damaged stays.
            if _OURS.fullmatch(path.name) and path.suffix != ".damaged" and path.name not in kept:
                path.unlink()


def _content(path: Path) -> dict[str, Any]:
    """Return the unverified content of a JSON file; empty if it is missing or cannot be read."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        found = json.loads(path.read_text())["content"]
        return found if isinstance(found, dict) else {}
    return {}


def read_checkpoint(path: Path) -> Checkpoint:
    """Read and verify a pair by the path of its JSON file; tensors are on the CPU.

    Raises DamagedCheckpointError that says what is wrong, CheckpointError for a format of another version.
    """
    tensor_path = path.with_suffix(".safetensors")  # unless the JSON file says otherwise
    try:
        outer = json.loads(path.read_text())
        content = outer["content"]
        if outer["crc"] != zlib.crc32(json.dumps(content).encode()):
            raise DamagedCheckpointError(f"checkpoint {path} is damaged: its checksum does not fit")
        if content["format"] != FORMAT:
            raise CheckpointError(
                f"checkpoint {path} has format {content['format']}, this version reads {FORMAT}: start again (--fresh)"
            )
        if _TENSORS.fullmatch(content.get("file", tensor_path.name)) is None:
            raise DamagedCheckpointError(f"checkpoint {path} is damaged: it names no file of tensors")
        tensor_path = path.with_name(content.get("file", tensor_path.name))
        with safe_open(tensor_path, framework="pt") as file:
            if (file.metadata() or {}).get("pair") != content["pair"]:
                raise DamagedCheckpointError(f"checkpoint {path} and {tensor_path.name} do not belong together")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if tensors.keys() != content["tensors"].keys():
            raise DamagedCheckpointError(f"checkpoint {tensor_path} does not hold the tensors that {path.name} lists")
        for name, tensor in tensors.items():
            if _crc(tensor) != content["tensors"][name]:
                raise DamagedCheckpointError(f"checkpoint {tensor_path} is damaged: tensor '{name}' has changed")
        return Checkpoint.model_validate(content | {"state": join_tensors(content["state"], tensors)})
    except ValidationError as error:
        where, what = error.errors()[0]["loc"], error.errors()[0]["input"]
        raise DamagedCheckpointError(f"checkpoint {path} is damaged: '{where[0]}' is {what!r:.40}") from error
    except FileNotFoundError as error:
        raise DamagedCheckpointError(f"checkpoint {error.filename or tensor_path} is missing") from error
    except (OSError, SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedCheckpointError(f"checkpoint {path} cannot be read: {type(error).__name__}: {error}") from error


def split_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """Return `value` as JSON; its tensors (CPU, contiguous, no shared memory) go into `tensors` by path.

    Raises TypeError for what is neither a tensor nor JSON-able: it would come back as something else.
    """
    if isinstance(value, Tensor):
        if path in tensors:
            raise ValueError(f"two tensors of a checkpoint are called '{path}'")
        tensor = value.detach().cpu().contiguous()
        # safetensors refuses tensors that share memory (tied weights).
        used = {t.untyped_storage().data_ptr() for t in tensors.values() if t.numel()}
        if tensor.numel() and tensor.untyped_storage().data_ptr() in used:
            tensor = tensor.clone()
        tensors[path] = tensor
        return {TENSOR_KEY: path}
    if isinstance(value, Mapping):
        if TENSOR_KEY in value or not all(isinstance(k, str) for k in value):
            raise TypeError(f"checkpoint state at '{path}': keys must be strings other than '{TENSOR_KEY}'")
        return {k: split_tensors(v, tensors, f"{path}/{k}" if path else k) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [split_tensors(v, tensors, f"{path}/{i}") for i, v in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"checkpoint state at '{path}': {type(value).__name__} is neither a tensor nor JSON-able")


def join_tensors(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Undo `split_tensors` (tuples come back as lists)."""
    if isinstance(value, dict):
        if TENSOR_KEY in value:
            return tensors[value[TENSOR_KEY]]
        return {k: join_tensors(v, tensors) for k, v in value.items()}
    if isinstance(value, list):
        return [join_tensors(v, tensors) for v in value]
    return value


def _crc(tensor: Tensor) -> int:
    """CRC-32 of shape, dtype and bytes."""
    head = zlib.crc32(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
    content: Any = tensor.reshape(-1).view(torch.uint8).numpy()  # a buffer, which numpy's types do not say
    return zlib.crc32(content, head)


def normalised(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the identity after a JSON round trip, so that new and stored ones compare equal."""
    found: dict[str, Any] = json.loads(json.dumps(identity, default=str, sort_keys=True))
    return found


def differences(checkpoint: Checkpoint, identity: Mapping[str, Any], plan: Sequence[str], extent: float) -> list[str]:
    """Return a line for each difference between a checkpoint's identity, plan or extent and this run's."""
    old, new = dotted(checkpoint.identity), dotted(normalised(identity))
    lines = []
    for key in sorted(old.keys() | new.keys()):
        before, now = old.get(key, "absent"), new.get(key, "absent")
        if before != now:
            lines.append(f"{key}: {_short(before)} -> {_short(now)}")
    if abs(checkpoint.extent - extent) > 1e-6 * max(abs(extent), 1e-12):
        lines.append(f"scene extent: {checkpoint.extent:.6g} -> {extent:.6g}")
    lines += [f"plan {line}" for line in difflib.ndiff(checkpoint.plan, list(plan)) if line[0] in "+-"]
    return lines


def _short(value: Any) -> str:
    """Shorten a value for a message: digests and long lists are cut."""
    text = str(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
