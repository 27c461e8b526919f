"""Operations of plain C faces on CUDA are called by their wrappers as headers say; stand-ins do for GPU and library."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import NativeModule
from splatwizard_native import face as native_face
from splatwizard_native.face import OPERATION, read_structs, structure

STREAM = 4711
DECLARED = [resolve_module(target) for target in declared_modules(load_plugins())]
MODULES = [m.cuda for m in DECLARED if m.cuda is not None and m.cuda.face]


def rand(*shape: int, grad: bool = False) -> Any:
    return torch.rand(shape, requires_grad=grad)


class Library:
    """Stands for the library of a module: notes what its operations are handed, and says that all went well."""

    def __init__(self, module: NativeModule, calls: dict[str, list[Any]]) -> None:
        self.module, self.calls, self.structs = module, calls, read_structs(module.face_header)

    def __getattr__(self, name: str) -> Any:
        operation = name.removeprefix(f"{self.module.name}_")
        if operation == "last_error":
            return lambda: b"refused"
        kind = structure(operation, self.structs[f"{operation}_call"], call=True)

        def call(reference: Any) -> int:
            handed = kind.from_buffer_copy(reference._obj)
            assert (handed.size, handed.abi) == (ctypes.sizeof(kind), native_face.ABI)
            assert (handed.device, handed.stream) == (0, STREAM)
            self.calls.setdefault(operation, []).append(handed)
            return 0

        return call


@pytest.fixture
def calls(monkeypatch) -> Iterator[dict[str, list[Any]]]:
    """The structs that were handed to the operations so far, by operation; all tensors say that they are on a GPU."""
    found: dict[str, list[Any]] = {}
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda device: STREAM + device, raising=False)
    monkeypatch.setattr(NativeModule, "has_cuda", lambda self: True)
    monkeypatch.setattr(NativeModule, "library", property(lambda self: Library(self, found)))
    for name, told in {"is_cuda": True, "is_cpu": False, "device": torch.device("cuda", 0)}.items():
        monkeypatch.setattr(torch.Tensor, name, property(lambda self, told=told: told), raising=False)
    monkeypatch.setattr(torch.Tensor, "get_device", lambda self: 0, raising=False)
    faces = [m for name, m in sys.modules.items() if name.endswith("cuda_face")]
    before = [dict(vars(face)) for face in faces]
    for face in faces:
        for module in MODULES:
            for _, name in OPERATION.findall(module.face_header):
                monkeypatch.delattr(face, name, raising=False)
    yield found
    for face, names in zip(faces, before, strict=True):
        for name in set(vars(face)) - set(names):
            delattr(face, name)


def test_wisp(calls, monkeypatch):
    from sw_wisp.appearance import AppearanceNetwork
    from sw_wisp.context import ContextNetworks
    from sw_wisp.fast import predicted
    from sw_wisp.fast.splats import drawable
    from sw_wisp.pyramid import FEATURES
    from sw_wisp.rounding import SOFT, Rounding

    places = predicted._tie_places
    monkeypatch.setattr(predicted, "_tie_places", lambda device: places(torch.device("cpu")))
    values, networks = rand(7, 22, grad=True), ContextNetworks()
    networks.rounds = True
    given = (rand(7, FEATURES), rand(7, FEATURES), values, Rounding(SOFT, 3.0))
    forecast, drawn = predicted.predicted(networks, *given, moves_steps=False)
    assert not forecast.steps.requires_grad
    (weights,) = calls["eight_bits"]
    assert (weights.count, weights.lowest, list(weights.rows[:3]), weights.rows[13]) == (13, -12, [32, 3, 48], 0)
    assert [(call.block, call.phase, call.sharpness) for call in calls["draw"]] == [(b, 2, 3.0) for b in range(4)]
    assert {call.rows for call in calls["draw"]} == {7}
    found = torch.autograd.grad(drawn, (values, *networks.parameters()), rand(7, 22))
    assert [each.shape for each in found[1:]] == [each.shape for each in networks.parameters()]
    (back,) = calls["draw_backward"]
    assert (back.moves_steps, back.by_mean, back.by_drawn is None) == (False, None, False)
    assert back.noise == calls["draw"][0].noise
    bits = predicted.bits_of(drawn, forecast, 3)
    assert (bits.shape, calls["bits"][0].last) == ((3, 22), 3)
    torch.autograd.grad(bits, drawn, rand(3, 22))
    (back,) = calls["bits_backward"]
    assert (back.rows, back.last, back.to_values is None) == (7, 3, False)

    opacities, covariances, dc, rest, *_ = drawable(values, rand(7), (-2.0, 1.0), AppearanceNetwork())
    assert (opacities.shape, covariances.shape, dc.shape, rest.shape) == ((7,), (7, 6), (7, 1, 3), (7, 15, 3))
    assert calls["splats"][0].covariances == covariances.data_ptr()
    torch.autograd.grad(covariances, values, rand(7, 6))
    (back,) = calls["splats_backward"]
    assert (back.low, back.high, back.rows, back.by_opacities, back.by_colour) == (-2.0, 1.0, 7, None, None)


def test_every_operation_is_named_here():
    text = Path(__file__).read_text("utf-8")
    for module in MODULES:
        declared = {op for owner, op in OPERATION.findall(module.face_header) if owner == module.name}
        assert not {op for op in declared if f'"{op}"' not in text}, module.name
