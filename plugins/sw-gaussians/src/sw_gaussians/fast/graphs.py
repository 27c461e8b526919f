"""CUDA-graph capture of a differentiable computation with fixed input and output tensors.

`CapturedStep` records it as two CUDA graphs, forward and backward, which the host then starts with one call each
instead of hundreds. `PlainStep` is the same without graphs. Both compute from tensors that their owner fills
beforehand.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

WARM_UP_RUNS = 3
"""Runs before a device's first capture, in which libraries set themselves up; as torch's own `make_graphed_callables`.
Before a later one there is one, which loads what its shapes need."""

Found = tuple[tuple[Tensor, ...], tuple[Tensor, ...]]
"""Results of a computation: those that have a gradient, and others."""


class FixedStep(Protocol):
    """Protocol of one computation on fixed tensors."""

    def forward(self) -> Found:
        """Compute from the inputs as they are now; the tensors hold until the next call."""
        ...

    def room(self) -> Sequence[Tensor]:
        """Zeros, one for each differentiable result of `forward`: room for the gradients of one call of `backward`."""
        ...

    def backward(self, slopes: Sequence[Tensor | None]) -> tuple[Tensor | None, ...]:
        """Gradients of the inputs (None: it has none) for the gradients of the differentiable results of `forward`.

        They hold until the next call; every result of `forward` is still as it was. What `room` gave is not copied.
        """
        ...


class PlainStep:
    """A FixedStep that runs its operators one by one, on any device."""

    def __init__(self, compute: Callable[[], Found], inputs: Sequence[Tensor]) -> None:
        self._compute, self._inputs = compute, tuple(inputs)
        self._results: tuple[Tensor, ...] = ()

    def forward(self) -> Found:
        with torch.enable_grad():
            self._results, others = self._compute()
        return self._results, others

    def room(self) -> Sequence[Tensor]:
        return [torch.zeros_like(each) for each in self._results]

    def backward(self, slopes: Sequence[Tensor | None]) -> tuple[Tensor | None, ...]:
        results, self._results = self._results, ()
        return differentiate(results, self._inputs, slopes)


class CapturedStep:
    """A FixedStep as two CUDA graphs on the current device.

    Raises RuntimeError if the computation cannot be captured: it waits for the device, or its shapes depend on values.
    """

    def __init__(
        self, compute: Callable[[], Found], inputs: Sequence[Tensor], pool: tuple[int, int] | None = None
    ) -> None:
        """pool: memory shared with other steps (`torch.cuda.graph_pool_handle`), of which one runs at a time."""
        current = torch.cuda.current_stream()
        stream = _side_stream(current.device_index)
        stream.wait_stream(current)
        # In this thread, or the engine's own would launch what this one's stream is to record.
        with torch.cuda.stream(stream), torch.enable_grad(), torch.autograd.set_multithreading_enabled(False):
            for _ in range(WARM_UP_RUNS if current.device_index not in _WARM else 1):
                results, _ = compute()
                slopes = tuple(torch.zeros_like(each) for each in results)
                differentiate(results, inputs, slopes)
            del results
            _WARM.add(current.device_index)
            self._slopes = slopes
            torch.cuda.synchronize()
            torch.cuda.empty_cache()  # what the warm-ups took on this stream serves no other
            self._forward, self._backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
            with _recording(self._forward, pool):
                results, others = compute()
            with _recording(self._backward, pool):
                found, room = differentiate(results, inputs, self._slopes), {storage_of(x) for x in self._slopes}
                self._grads = tuple(x.clone() if x is not None and storage_of(x) in room else x for x in found)
                torch._foreach_zero_(self._slopes)  # for the next time
        current.wait_stream(stream)
        # What backward needs of forward stays where it is, though nothing holds it: the graphs keep the pool, and its
        # next capture may take the place, whose replays then come between no forward and backward of this one.
        self._found = tuple(each.detach() for each in results), tuple(each.detach() for each in others)

    def forward(self) -> Found:
        self._forward.replay()
        return self._found

    def room(self) -> Sequence[Tensor]:
        return self._slopes

    def backward(self, slopes: Sequence[Tensor | None]) -> tuple[Tensor | None, ...]:
        pairs = zip(self._slopes, slopes, strict=True)
        given = [(mine, slope) for mine, slope in pairs if slope is not None and slope is not mine]
        if given:
            torch._foreach_copy_([mine for mine, _ in given], [slope for _, slope in given])
        self._backward.replay()
        return self._grads


def storage_of(tensor: Tensor) -> int:
    """Address of the memory that a tensor shares with its views."""
    return tensor.untyped_storage().data_ptr()


_WARM: set[int] = set()


@functools.cache
def _side_stream(device: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


@contextmanager
def _recording(graph: torch.cuda.CUDAGraph, pool: tuple[int, int] | None) -> Iterator[None]:
    """Capture the current stream, unlike `torch.cuda.graph` without emptying the allocator's cache."""
    collecting = gc.isenabled()
    gc.disable()  # a graph or an event that is freed meanwhile would end the capture
    try:
        graph.capture_begin(*(() if pool is None else (pool,)), capture_error_mode="thread_local")
        try:
            yield
        except BaseException:
            with suppress(RuntimeError):  # it says no more than that something went wrong
                graph.capture_end()
            raise
        graph.capture_end()
    finally:
        if collecting:
            gc.enable()


def differentiate(
    results: Sequence[Tensor], inputs: Sequence[Tensor], slopes: Sequence[Tensor | None]
) -> tuple[Tensor | None, ...]:
    """Gradients of `inputs`, each contiguous and of 16-byte alignment, as the optimizer's kernel asks for; or None."""
    pairs = [(r, s) for r, s in zip(results, slopes, strict=True) if r.requires_grad and s is not None]
    found = torch.autograd.grad([r for r, _ in pairs], inputs, [s for _, s in pairs], allow_unused=True)
    return tuple(None if grad is None else _in_order(grad) for grad in found)


def _in_order(grad: Tensor) -> Tensor:
    grad = grad.contiguous()
    return grad if grad.data_ptr() % 16 == 0 else grad.clone()


def add_gradients(parameters: Sequence[Tensor], grads: Sequence[Tensor | None]) -> None:
    """Add gradients to those of leaves; where there are none yet, they become these very tensors.

    Returned by a node instead, autograd would copy each of them, since a FixedStep holds it too.
    """
    for parameter, grad in zip(parameters, grads, strict=True):
        if grad is not None and parameter.grad is None:
            parameter.grad = grad
        elif grad is not None and parameter.grad is not None:
            parameter.grad.add_(grad)


@dataclass
class Watched:
    """Parameters and buffers whose addresses a captured computation reads.

    tensors     of each: the dict that holds it, its name there, itself, its address, whether it learns
    """

    tensors: list[tuple[dict[str, Any], str, Tensor, int, bool]]

    @classmethod
    def of(cls, module: nn.Module, but: Collection[str] = ()) -> Watched:
        """All tensors of a module and its submodules, but those of its own that are named."""
        return cls(
            [
                (held, name, tensor, tensor.data_ptr(), tensor.requires_grad)
                for path, part in module.named_modules()
                for held in (part._parameters, part._buffers)
                for name, tensor in held.items()
                if tensor is not None and (path or name not in but)
            ]
        )

    @property
    def learning(self) -> list[Tensor]:
        """Tensors among the watched ones that learn."""
        return [tensor for _, _, tensor, _, learns in self.tensors if learns]

    def unchanged(self) -> bool:
        """Return whether each tensor is still the same object at the same address, with the same requires_grad."""
        return all(
            held.get(name) is tensor and tensor.data_ptr() == address and tensor.requires_grad == learns
            for held, name, tensor, address, learns in self.tensors
        )


def plain_values(holder: object, but: Collection[str] = ()) -> list[Any]:
    """Return an object's numbers and strings, which decide the operators that run, but those that are named."""
    return [
        (name, value)
        for name, value in vars(holder).items()
        if (type(value) in _PLAIN or (type(value) is tuple and all(type(each) in _PLAIN for each in value)))
        and name not in but
    ]


_PLAIN = frozenset((bool, int, float, str))
