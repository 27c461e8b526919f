"""Every operation on CUDA is called by its wrapper as its header says; stand-ins do for GPU and libraries."""

from __future__ import annotations

import ctypes
import dataclasses
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import AdamUpdate, NativeModule, Repeated, offer_update
from splatwizard_native import face as native_face
from splatwizard_native.face import OPERATION, read_structs, structure

STREAM = 4711
RESULTS: dict[str, dict[str, int]] = {}
"""Operation -> results that are not 0."""
DECLARED = [resolve_module(target) for target in declared_modules(load_plugins())]
MODULES = [m.cuda for m in DECLARED if m.cuda is not None]


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
            for field, value in RESULTS.get(operation, {}).items():
                setattr(reference._obj, field, value)
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
    for place in ("splatwizard_native.fused.photometric", "sw_gaussians.fast.statistics"):
        module = importlib.import_module(place)
        for name, one in list(vars(module).items()):
            if isinstance(one, Repeated):  # it would go on calling the library of another test, or of a GPU
                monkeypatch.setattr(module, name, Repeated(one._face, one._name))
    faces = [m for name, m in sys.modules.items() if name.endswith("cuda_face")]
    before = [dict(vars(face)) for face in faces]
    for face in faces:
        for native in MODULES:
            for _, name in OPERATION.findall(native.face_header):
                monkeypatch.delattr(face, name, raising=False)
    yield found
    for face, names in zip(faces, before, strict=True):
        for name in set(vars(face)) - set(names):
            delattr(face, name)


def test_training(calls):
    from splatwizard_native.fused.adam import AdamUpdate, adam_steps
    from splatwizard_native.fused.photometric import photometric

    x, y = rand(3, 40, 70, grad=True), rand(3, 40, 70)
    total, l1, _ = photometric(x, y, 0.2)
    total += 1.0  # as a term that a stage adds
    (grad,) = torch.autograd.grad(total, x, torch.ones(()))
    assert grad.shape == x.shape
    (first,) = calls["photometric_loss"]
    sums, slopes = 2 + 2 * 18, 3 * 3 * 40 * 70
    assert (first.planes, first.height, first.width, first.valid) == (3, 40, 70, False)
    assert (first.l1_weight, first.ssim_weight, first.offset) == (0.8, -0.2, 0.2)
    assert (first.scratch_count, first.grad is None, first.found) == (sums + slopes, False, l1.data_ptr() - 4)
    with torch.no_grad():
        photometric(x, y, 0.2, "valid")
    second = calls["photometric_loss"][1]
    assert (second.scratch_count, second.grad, second.valid) == (sums, None, True)

    update = AdamUpdate(*(rand(4, 4) for _ in range(4)), lr=0.1, beta1=0.9, beta2=0.99, eps=1e-8, step=1)
    version = update.param._version
    adam_steps([update, update])
    assert calls["adam"][0].count == 2
    assert update.param._version > version


def test_gaussians(calls):
    from sw_gaussians.fast.sparse_adam import left_of
    from sw_gaussians.fast.statistics import accumulate, accumulate_fragments
    from sw_gaussians.surface_losses import _disagreement

    from splatwizard_native import AdamUpdate

    updates = [AdamUpdate(*(rand(6, width) for _ in range(4)), 0.1, 0.9, 0.99, 1e-8, 1) for width in (1, 4)]
    updates.append(AdamUpdate(*(rand(7, 2) for _ in range(4)), 0.1, 0.9, 0.99, 1e-8, 1))
    assert left_of(updates, torch.ones(6, dtype=torch.bool)) == updates[2:]
    assert (calls["sparse_adam"][0].count, calls["sparse_adam"][0].rows) == (2, 6)

    sums = SimpleNamespace(grad_accum=rand(5), denom=rand(5), max_radii2d=rand(5))
    assert accumulate(sums, rand(5, 2), torch.ones(5, dtype=torch.int32))
    assert calls["view_statistics"][0].rows == 5
    assert accumulate_fragments(rand(5, 3), rand(5), rand(5), rand(5, 2), least_clear=0.5)
    assert calls["fragment_statistics"][0].least_clear == 0.5
    assert not accumulate_fragments(rand(5, 3), rand(5), rand(5).double(), rand(5, 2), least_clear=0.5)

    depth, normals = rand(1, 4, 6, grad=True), rand(3, 4, 6, grad=True)
    lens = SimpleNamespace(fx=1.0, fy=2.0, cx=3.0, cy=4.0)
    found = _disagreement(depth, normals, rand(1, 4, 6), lens)
    to_depth, to_normals = torch.autograd.grad(found, (depth, normals), rand(1, 4, 6))
    (back,), (there,) = calls["disagreement_backward"], calls["disagreement"]
    assert (back.depth, back.alpha) == (there.depth, there.alpha)
    assert (back.height, back.width, back.fx, back.fy, back.cx, back.cy) == (4, 6, 1, 2, 3, 4)
    assert (back.to_depth, back.to_normals) == (to_depth.data_ptr(), to_normals.data_ptr())


class ChannelNetworks:
    """Networks of channels that say zero."""

    context = True

    def __init__(self, features: int) -> None:
        self.columns = torch.zeros(3, features, dtype=torch.int32)

    def check_for(self, features, device):
        assert self.columns.shape[1] == features

    def packed(self, parameters):
        return torch.cat([each.flatten() for each in parameters])

    def unpacked(self, packed, factor):
        return [packed * factor]

    def forward(self, packed, inputs):
        return inputs, inputs.new_zeros(len(inputs), 3 * self.columns.shape[1])

    def backward(self, packed, inputs, hidden, slopes):
        return torch.zeros_like(inputs), torch.zeros_like(packed)


def test_hac(calls):
    from sw_hac.fast.predicted_bits import MaskKind, Predicted, mixture_bits

    features, k, count = 4, 2, 7
    numbers = features + 6 + 3 * k
    width = 2 * numbers + features
    x, outputs, steps = rand(count, numbers, grad=True), rand(count, width, grad=True), rand(count, 3, grad=True)
    masks, weights = rand(count, k, grad=True), rand(5, grad=True)
    predicted = Predicted(rand(width), 0.5, 1e-6, 1e-9, 0.05, MaskKind.GATED)
    given = (x, outputs, steps, masks, rand(count), predicted)
    bits, _ = mixture_bits(*given, ChannelNetworks(features), (weights,))
    torch.autograd.grad(bits, (x, outputs, steps, masks, weights), torch.ones(()))
    (first,), (inputs,), (back,) = (calls[name] for name in ("mixture_bits", "channel_inputs", "channel_slopes"))
    assert (first.count, first.numbers, first.width, first.features, first.k) == (count, numbers, width, features, k)
    assert (first.kind, first.second is None, first.to_second is None) == (1, False, False)
    assert (inputs.columns, back.columns) == (20, 20)
    assert back.by_x == first.to_x
    bits, _ = mixture_bits(*given)
    torch.autograd.grad(bits, x, torch.ones(()))
    assert (calls["mixture_bits"][1].second, calls["channel_slopes"][1].by_inputs) == (None, None)


def test_anchors(calls, monkeypatch):
    from sw_anchors.anchors import two_layers
    from sw_anchors.fast import networks, rows, sample_bits, spawn

    n, k, inputs = 5, 4, 8
    monkeypatch.setattr(networks, "fits_kernel", lambda *_: True)
    generator = torch.Generator().manual_seed(0)
    three = tuple(two_layers(inputs + 4, 6, outputs * k, generator) for outputs in (1, 7, 3))
    parameters = networks.parameters_of(three)
    positions, features = rand(n, 3), rand(n, inputs + 9, grad=True)
    outputs = networks.network_outputs(rand(3), positions, features[:, :inputs], three)
    assert [each.shape for each in outputs] == [(n, k), (n, 7 * k), (n, 3 * k)]
    slopes = [torch.ones_like(each) for each in outputs]
    grads = torch.autograd.grad(outputs, [features, *parameters], slopes)
    assert [grad.shape for grad in grads[1:]] == [parameter.shape for parameter in parameters]
    (first,), (back,), (sizes,) = (
        calls[name] for name in ("view_networks", "view_networks_backward", "view_networks_sizes")
    )
    assert (first.n, first.inputs, first.units, first.k, first.geometry_count) == (n, inputs, 6, k, 7 * k)
    assert (first.feature_row, back.total % 4, sizes.n) == (inputs + 9, 0, n)
    assert back.total >= sum(parameter.numel() for parameter in parameters)

    alpha, geometry, color = (each.detach().requires_grad_() for each in outputs)
    offsets, scales, masks = rand(n, k * 3, grad=True), rand(n, 6, grad=True), rand(n, k, grad=True)
    drawn = torch.tensor([0, 3, 7])
    given = (alpha, geometry, color, positions, offsets.view(n, k, 3), scales, masks)
    found = spawn._Gaussians.apply(drawn, *given)
    learning = alpha, geometry, color, offsets, scales, masks
    grads = torch.autograd.grad(found, learning, [torch.ones_like(each) for each in found])
    assert [grad.shape for grad in grads] == [each.shape for each in learning]
    (back,) = calls["spawn_backward"]
    assert (back.n, back.k, back.count, back.to_positions, back.ordered) == (n, k, 3, None, False)
    assert calls["spawn"][0].offset_row == 3 * k

    numbers = inputs + 6 + 3 * k
    values, mean, scale, steps = (rand(n, columns, grad=True) for columns in (numbers, numbers, numbers, 3))
    bits, _ = sample_bits.bits_of(values, mean, scale, steps, masks, rand(n), 1e-6, 1e-9)
    torch.autograd.grad(bits, values, torch.ones(()))
    assert calls["sample_bits"][0].numbers == numbers

    index = torch.tensor([1, 4])
    rows.load_rows(index, [positions, scales.detach()], [rand(3, 3), rand(2, 6)])
    taken = rows.take_rows(index, positions, features[:, :inputs])
    assert [each.shape for each in taken] == [(2, 3), (2, inputs)]
    (put,) = torch.autograd.grad(taken[1], features, rand(2, inputs))
    assert put.shape == features.shape
    rows.add_rows(index, [rand(2, 6)], [scales.detach()])
    copied = [(call.way, call.tensors, call.count, call.cleared) for call in calls["copy_rows"]]
    assert copied == [(0, 2, 2, 0), (0, 2, 2, 0), (1, 1, 2, n), (2, 1, 2, 0)]
    assert list(calls["copy_rows"][1].source_rows[:3]) == [3, inputs + 9, 0]
    with pytest.raises(RuntimeError, match="2 rows of"):
        rows.add_rows(index, [rand(2, 5)], [scales.detach()])

    of_rows = [rand(n, columns, grad=True) for columns in (inputs, 6, 3 * k, k)]
    each_step = rand(n, 3, grad=True)
    values, groups, masks, _ = rows.noisy_rows(
        of_rows, rand(n, 1), torch.tensor(4.0), rand(n * numbers), each_step, 0.01
    )
    torch.autograd.grad(
        (values, groups[0], masks), [*of_rows, each_step], [torch.ones_like(t) for t in (values, groups[0], masks)]
    )
    (back,), (there,) = calls["row_values_backward"], calls["row_values"]
    assert (there.threshold, back.steps) == (0.01, each_step.data_ptr())
    assert (back.count, back.width, back.k, back.step_rows) == (n, inputs, k, n)
    assert (list(back.by_rows), back.by_scales) == ([numbers, inputs, 0, 0, k], None)


def test_rows_that_are_alike_are_checked_once(calls):
    from sw_anchors.fast.rows import AlikeRows, Way

    load, put, add = AlikeRows(Way.GATHER), AlikeRows(Way.SCATTER), AlikeRows(Way.ADD)
    into = [rand(4, 3), rand(4, 6)]
    for count in (3, 2):
        rows, sources = torch.arange(count), [rand(9, 3), rand(9, 2, 3)]
        load.load(rows, sources, into)
        call = calls["copy_rows"][-1]
        assert (call.way, call.tensors, call.count, call.cleared, call.rows) == (0, 2, count, 0, rows.data_ptr())
        assert list(call.sources[:3]) == [*(x.data_ptr() for x in sources), None]
        assert list(call.targets[:3]) == [*(x.data_ptr() for x in into), None]
        assert list(call.words[:3]) == list(call.source_rows[:3]) == list(call.target_rows[:3]) == [3, 6, 0]

        first, none, last = put.put(rows, [into[0], None, into[1]], [torch.Size(x) for x in ((7, 3), (7,), (7, 2, 3))])
        call = calls["copy_rows"][-1]
        assert (none, first.shape, last.shape) == (None, (7, 3), (7, 2, 3))
        assert (call.way, call.count, call.cleared, call.targets[1]) == (1, count, 7, last.data_ptr())

        totals = [rand(7, 3), None, rand(7, 2, 3)]
        add.add(rows, [into[0], into[0], into[1]], totals)
        call = calls["copy_rows"][-1]
        assert (call.way, call.tensors, call.cleared, call.targets[1]) == (2, 2, 0, totals[2].data_ptr())
    for more in (rand(9, 3)[:, :2], rand(9, 3).double()):  # of another form: checked anew
        load.load(torch.arange(2), [more, rand(9, 6)], [rand(4, more.shape[1]).to(more.dtype), rand(4, 6)])
    assert [call.words[0] for call in calls["copy_rows"][6:]] == [2]  # eight bytes a number: by torch
    wide = rand(9, 8)
    for count in (1, 3):  # one row of five is contiguous, three with the same strides are not
        load.load(torch.arange(count), [wide[:count, :5]], [rand(4, 5)])
        assert list(calls["copy_rows"][-1].source_rows[:1]) == [5 if count == 1 else 8]
    load = AlikeRows(Way.GATHER)
    load.load(torch.arange(2), [rand(9, 3), rand(9, 6)], into)
    before = len(calls["copy_rows"])
    with pytest.raises((IndexError, RuntimeError)):
        load.load(torch.arange(5), [rand(9, 3), rand(9, 6)], into)
    assert len(calls["copy_rows"]) == before


def test_gaussians_that_are_alike_are_checked_once(calls):
    from sw_anchors.fast.spawn import AlikeGaussians

    kept, n, k = AlikeGaussians(), 5, 4
    for m in (3, 2):
        matrix, drawn = rand(n, 40), torch.arange(m)
        given = (rand(n, k), rand(n, 7 * k), rand(n, 3 * k), rand(n, 3), matrix[:, 6:18].view(n, k, 3), matrix[:, :6],
                 rand(n, k))  # fmt: skip
        found = kept.spawned(drawn, given)
        assert [x.shape for x in found] == [(m, 3), (m,), (m, 3), (m, 4), (m, 3)]
        into = [rand(n, k), rand(n, 7 * k), rand(n, 3 * k), rand(n, k, 3), rand(n, 6), rand(n, k)]
        kept.add_gradients(drawn, given, found, into)
        there, back = calls["spawn"][-1], calls["spawn_backward"][-1]
        assert (there.n, there.k, there.count, there.drawn) == (n, k, m, drawn.data_ptr())
        assert (there.offset_row, there.scale_row, there.offsets) == (40, 40, given[4].data_ptr())
        assert (there.alpha, there.masks, there.colors) == (*(x.data_ptr() for x in (given[0], given[6], found[4])),)
        assert (back.count, back.by_colors, back.to_positions, back.ordered) == (m, there.colors, None, False)
        assert (back.to_alpha, back.to_masks) == (into[0].data_ptr(), into[5].data_ptr())
    with pytest.raises(RuntimeError, match="positions must be"):
        AlikeGaussians().spawned(drawn, (*given[:3], rand(n, 2), *given[4:]))


def test_statistics_of_anchors(calls):
    from sw_anchors.anchors import AnchorSelection
    from sw_anchors.growth import accumulate_anchor_statistics

    rows, drawn, radii = torch.tensor([1, 4]), torch.tensor([0, 3, 7]), torch.ones(3, dtype=torch.int32)
    shapes = {"opacity_accum": (5,), "anchor_denom": (5,), "offset_grad_accum": (5, 4), "offset_denom": (5, 4)}
    model = SimpleNamespace(**{name: rand(*shape) for name, shape in shapes.items()})
    version = model.offset_denom._version
    accumulate_anchor_statistics(model, AnchorSelection(rows, rand(2, 4), drawn), rand(3, 4)[:, :2], radii)
    (call,) = calls["add_statistics"]
    assert (call.seen, call.k, call.count, call.total) == (2, 4, 3, 5)
    assert (call.rows, call.drawn, call.radii) == (rows.data_ptr(), drawn.data_ptr(), radii.data_ptr())
    assert (call.opacity_accum, call.offset_denom) == (model.opacity_accum.data_ptr(), model.offset_denom.data_ptr())
    assert model.offset_denom._version > version


LEVELS = [4.0, 8.0], [5, 9], [0, 216], [1, 0], 9
"""A dense and a hashed level over three axes, of 216 and 512 entries."""


def test_grids(calls):
    from sw_codecs.fast import kernel_operations as codecs

    x, values, gradient = rand(5, 3), rand(728, 2), rand(5, 4)
    assert codecs.lookup(x, values, *LEVELS).shape == (5, 4)
    assert codecs.backward(x, gradient, 728, 2, *LEVELS).shape == (728, 2)
    codecs.backward(x, gradient, 728, 2, *LEVELS, largest=torch.ones(()))
    (lookup,), (plain, ordered) = calls["grid_lookup"], calls["grid_backward"]
    assert (lookup.count, lookup.axes, lookup.entries, lookup.features, lookup.levels) == (5, 3, 728, 2, 2)
    assert (list(lookup.scales[:3]), list(lookup.dense[:3])) == ([4, 8, 0], [1, 0, 0])
    assert (plain.largest, plain.sums, ordered.sums is None, ordered.largest is None) == (None, None, False, False)
    codecs.signs_lookup(x, (0, 1, 2), values, rand(5, 7), 3, *LEVELS)
    codecs.signs_backward(x, (0, 2), values, rand(5, 7), 3, [4.0], [5], [0], [1], 9, largest=torch.ones(()))
    (lookup,), (back,) = calls["signs_lookup"], calls["signs_backward"]
    assert (lookup.row, lookup.first, lookup.dimensions, back.dimensions, list(back.axes)) == (7, 3, 3, 2, [0, 2, 0])


@pytest.mark.parametrize("deterministic", [False, True])
def test_planes(calls, monkeypatch, deterministic):
    from sw_cat_3dgs.fast import plane_kernels

    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: deterministic)
    planes = [rand(3, 4, 8, 9), rand(3, 4, 16, 18)]
    assert plane_kernels.fit_kernels(planes)
    sums, to_planes = plane_kernels.plane_bits(planes, rand(3, 1058), planes_learn=True)
    assert (sums.shape, [each.shape for each in to_planes]) == ((3, 1060), [plane.shape for plane in planes])
    (call,), (sizes,) = calls["plane_bits"], calls["plane_bits_sizes"]
    assert (sizes.scales, sizes.channels) == (2, 4)
    assert (call.scales, call.orientations, call.channels, call.parts) == (2, 3, 4, 0)
    assert (list(call.heights), list(call.widths)) == ([8, 16, 0, 0], [9, 18, 0, 0])
    assert list(call.ordered_counts) == ([3 * 192 * 9, 3 * 192 * 36, 0, 0] if deterministic else [0] * 4)
    assert plane_kernels.plane_bits(planes, rand(3, 1058), planes_learn=False)[1] == []
    assert list(calls["plane_bits"][1].to_planes) == [None] * 4

    cells, weights = torch.zeros(7, 2, 3, 4, dtype=torch.int32), rand(7, 2, 3, 4)
    features = plane_kernels.sampled(cells, weights, planes, 16.0)
    assert features.shape == (7, 2 * 3 * 4)
    found = plane_kernels.sampled_backward(cells, weights, features, planes)
    assert [each.shape for each in found] == [plane.shape for plane in planes]
    (call,), (back,) = calls["triplane_lookup"], calls["triplane_backward"]
    assert (call.count, call.scales, call.channels, call.width, call.gain) == (7, 2, 4, 24, 16)
    assert list(call.places) == list(back.places) == [72, 288, 0, 0]
    assert (back.largest is None, back.tables[0] is None, back.sums[0] is None) == (
        not deterministic, deterministic, not deterministic
    )  # fmt: skip
    with pytest.raises(RuntimeError, match=r"planes must be \[3,4,H,W\]"):
        plane_kernels.sampled(cells, weights, [planes[0], rand(3, 5, 2, 2)], 0.0)


@pytest.fixture
def drawn(calls, monkeypatch):
    """The calls, where every picture has room for its 7 splats and 20 pairs."""
    from sw_rasterizers import cuda

    monkeypatch.setattr(cuda, "_MAILBOXES", SimpleNamespace(address=lambda _: 64))
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(cuda, "_plan", cuda._plan.__wrapped__)
    monkeypatch.setattr(cuda, "_row_length", cuda._row_length.__wrapped__)
    monkeypatch.setitem(RESULTS, "plan_render", {"splat_bytes": 640, "scratch_bytes": 128, "list_bytes": 256})
    monkeypatch.setitem(RESULTS, "plan_sums", {"row_length": 9, "blend_bytes": 64, "score_bytes": 64})
    monkeypatch.setitem(RESULTS, "render", {"complete": True, "used": 7, "pairs": 20, "kept_in": 1, "seen": 8})
    return calls


def view_of(flags: int = 4, **more: Any) -> Any:
    from sw_rasterizers.call import Call, Flag

    camera = [1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 2, 30, 30, 16, 12, 0.2, 100]
    return Call(camera, 32, 24, 1, 1.0, 0.3, Flag(flags), **more)


def tensors_of(n: int = 8, columns: int = 3) -> dict[str, Any]:
    shapes = {"means": (n, 3), "opacities": (n,), "scales": (n, columns), "quats": (n, 4), "sh_dc": (n, 1, 3),
              "sh_rest": (n, 3, 3)}  # fmt: skip
    return {name: rand(*shape, grad=True) for name, shape in shapes.items()}


def test_pictures(drawn):
    from splatwizard_core.api import GradBuffer
    from sw_rasterizers import ops

    call, tensors = view_of(background=rand(3), grad2d=GradBuffer(), flags=4 | 512), tensors_of()
    update = AdamUpdate(tensors["sh_rest"], *(rand(8, 3, 3) for _ in range(3)), 0.1, 0.9, 0.99, 1e-8, 2)
    offer_update(tensors["sh_rest"], update)
    image, radii, alpha, median = ops.rasterize(call, tensors)
    assert (image.shape, radii.shape, alpha.shape, median) == ((3, 24, 32), (8,), (1, 24, 32), None)
    assert call.counts == [8, 20, 0, 0, 0]
    version = tensors["sh_rest"]._version
    grads = torch.autograd.grad(
        (image, alpha), [*tensors.values()], [torch.ones_like(image), torch.ones_like(alpha)], allow_unused=True
    )
    shapes = [None if grad is None else grad.shape for grad in grads]
    assert shapes == [*(x.shape for x in list(tensors.values())[:5]), None]
    assert tensors["sh_rest"]._version > version
    (plan,), (render,), (blend,), (project,) = (
        drawn[name] for name in ("plan_render", "render", "blend_backward", "project_backward")
    )
    assert (render.count, render.shapes, render.rest_rows, render.color_channels, render.channels) == (8, 8, 3, 3, 3)
    assert (render.splat_bytes, render.list_bytes, render.mailbox, render.flags & 1024) == (640, 256, 64, 1024)
    assert (plan.room, plan.splat_room) == (render.room, render.splat_room)
    assert (blend.pair_splats, blend.lists, blend.used, blend.pairs) == (render.second, render.lists, 7, 20)
    assert (blend.color_channels, blend.count, blend.row_length, blend.by_median) == (3, 8, 9, None)
    assert (project.rows, project.drawn, project.maps) == (blend.rows, render.drawn, False)
    assert (project.rest_exp_avg, project.of_sh_rest, project.dc_exp_avg) == (update.exp_avg.data_ptr(), None, None)
    assert list(project.rest_rates)[:4] == pytest.approx([0.1 / (1 - 0.9**2), 0.1, 0.99, 0.01])
    assert call.grad2d.value.shape == (8, 2)


def test_pictures_of_inference(drawn, monkeypatch):
    from splatwizard_core.api import SH, Camera, GaussianInputs, RasterOptions
    from sw_rasterizers.inference import FlashRasterizer, TensorCoreRasterizer

    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    dc, rest = (tensors := tensors_of()).pop("sh_dc"), tensors.pop("sh_rest")
    g = GaussianInputs(**tensors, sh=SH(dc=dc, rest=rest, active_degree=1))
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, torch.eye(3), torch.ones(3))
    for kind in (FlashRasterizer, TensorCoreRasterizer):
        with torch.no_grad():
            image = kind().render(g, camera, RasterOptions(dtype_out="uint8")).image
        render = drawn["render"].pop()
        assert (image.dtype, render.levels) == (torch.uint8, image.data_ptr())
        assert (render.drawn, render.image) == (None, None)
        assert render.flags & (8192 | 16384) == kind.method


def stage_of(monkeypatch, **how: Any) -> tuple[Any, Any, Any, Any]:
    """A stage and what its whole step takes: state, view, camera."""
    from sw_gaussians.config import GaussianTraining
    from sw_gaussians.stage import ThreeDGSStage

    from splatwizard_core.api import Camera, GaussianModel
    from sw_rasterizers.standard import StandardRasterizer

    monkeypatch.setattr(torch, "zeros", lambda n, dtype, device: rand(n))
    inputs = tensors_of()
    raw = {"opacity_logits": inputs.pop("opacities"), "log_scales": inputs.pop("scales"), **inputs}
    model = GaussianModel.from_tensors(**raw)
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, torch.eye(3), torch.ones(3))
    view = SimpleNamespace(image=lambda background, device: rand(3, 24, 32))
    state = SimpleNamespace(model=model, rasterizer=StandardRasterizer(), step=1)
    return ThreeDGSStage(GaussianTraining(), **how), state, view, camera


def test_a_whole_step(drawn, monkeypatch):
    stage, state, view, camera = stage_of(monkeypatch)
    model, background = state.model, rand(3)
    for seed in range(3):  # the first is checked, the next are like it
        camera = dataclasses.replace(camera, tau=torch.tensor([0.0, 0.0, seed]))
        result, loss = stage.whole_step(state, view, camera, background)
        render, blend, project, first = (drawn[name][seed] for name in (
            "render", "blend_backward", "project_backward", "photometric_loss",
        ))  # fmt: skip
        assert render.camera[11] == blend.camera[11] == project.camera[11] == seed
        assert (render.background, blend.background, render.count) == (background.data_ptr(), background.data_ptr(), 8)
        assert (render.means, render.sh_rest) == (model.means.data_ptr(), model.sh_rest.data_ptr())
        assert (project.means, project.scales, project.drawn) == (render.means, render.scales, render.drawn)
        assert (blend.lists, blend.pair_splats, blend.used) == (render.lists, render.second, 7)
        assert (render.image, render.radii) == (first.x, result.radii.data_ptr())
        assert (render.image, loss.total.data_ptr()) == (result.image.data_ptr(), first.found)
        assert first.grad == blend.by_image
        assert blend.rows == project.rows
        assert result.grad2d.value.data_ptr() == project.of_grad2d
        made = {name: p.grad.data_ptr() for name, p in model.named_parameters()}
        assert made.pop("opacity_logits") != project.of_opacities  # times the slope of the sigmoid
        assert made == {
            "means": project.of_means, "quats": project.of_quats, "sh_dc": project.of_sh_dc,
            "sh_rest": project.of_sh_rest, "log_scales": project.of_scales,
        }  # fmt: skip
        kept = [result, loss, *(p.grad for p in model.parameters())]  # noqa: F841 - so that the next ones lie elsewhere
        model.zero_grad(set_to_none=True)


def test_updates_in_the_backward_pass_are_counted_and_the_others_done_by_the_optimizer(drawn, monkeypatch):
    stage, state, view, camera = stage_of(monkeypatch, fuses_updates=True)
    optimizer = stage.create_optimizer(state.model, SimpleNamespace(extent=1.0))
    stage._post = SimpleNamespace(registrations=[])
    for _ in range(3):
        optimizer.step(stage.whole_step(state, view, camera, rand(3))[0])
        optimizer.zero_grad()
    assert [call.count for call in drawn["adam"]] == [6, 4, 4]  # moments exist from the first update on
    moments, first = optimizer.states["sh_rest"].tensors, optimizer.groups["sh_rest"].lr / (1 - 0.9**3)
    last = drawn["project_backward"][-1]
    assert (last.rest_exp_avg, last.of_sh_rest) == (moments["exp_avg"].data_ptr(), None)
    assert last.rest_rates[0] == pytest.approx(first)
    assert {name: each.step for name, each in optimizer.states.items()} == dict.fromkeys(optimizer.groups, 3)


def test_a_picture_without_room_is_gone_on_with_and_one_of_too_many_pairs_refused(drawn, monkeypatch):
    from sw_rasterizers import cuda, ops

    monkeypatch.setattr(cuda._Recent, "pairs", 0)
    monkeypatch.setitem(RESULTS, "render", {"used": 7, "pairs": 5000})
    asked = []
    whole = cuda_face().render

    def render(**given):
        asked.append((given["room"] if "room" in given else given["first"].numel(), given["projected"]))
        found = whole(**given)
        found.complete = len(asked) > 1
        return found

    monkeypatch.setattr(cuda_face(), "render", render)
    tensors = tensors_of()
    with torch.no_grad():
        ops.rasterize(view_of(), tensors)
        assert asked[0] == (1024, False)
        assert asked[1][0] >= 5000
        assert asked[1][1]
        assert drawn["render"][0].splats == drawn["render"][1].splats
        monkeypatch.setenv(cuda.LIMIT, "4999")
        with pytest.raises(RuntimeError, match=r"^sw_rasterizers: 5000 splat-tile pairs are more than 4999: "):
            ops.rasterize(view_of(), tensors)


def cuda_face():
    from sw_rasterizers import cuda_face

    return cuda_face


def test_surfels(drawn):
    from sw_rasterizers.call import Flag
    from sw_rasterizers.surfel import _draw

    call, tensors = view_of(flags=4 | 512 | int(Flag.WITH_MAPS)), tensors_of(columns=2)
    image, _, _, maps = _draw(call, tensors)
    assert (image.shape, maps.shape) == ((3, 24, 32), (7, 24, 32))
    grads = torch.autograd.grad((image, maps), list(tensors.values()), [torch.ones_like(image), torch.ones_like(maps)])
    assert [grad.shape for grad in grads] == [x.shape for x in tensors.values()]
    assert drawn["render"][0].scale_columns == 2
    assert (drawn["project_backward"][0].maps, drawn["plan_sums"][0].maps) == (True, True)
    assert drawn["blend_backward"][0].by_alpha is None


@pytest.mark.parametrize("ordered", [0, 131072])
def test_scores(drawn, ordered):
    from splatwizard_core.api import RasterOptions, ScoreSpec
    from sw_rasterizers.scoring import _add_on_cuda

    tensors = {name: x.detach() for name, x in tensors_of().items()}
    weight = rand(24, 32)
    opt = RasterOptions(scores=(ScoreSpec("h", "hits"), ScoreSpec("g", "blend", pixel_weight=weight)), fisher=True)
    totals = SimpleNamespace(scores=rand(2, 8).double(), fisher=rand(8, 21).double())
    _add_on_cuda(
        {name: tensors.get(name) for name in (*tensors, "cov3d", "sh", "colors")},
        view_of(4 | ordered),
        opt.scores,
        totals,
    )
    (scores,), (fisher,), (render,) = (drawn[name] for name in ("accumulate_scores", "accumulate_fisher", "render"))
    assert (scores.scores, list(scores.kinds[:2]), scores.weights[1]) == (2, [0, 3], weight.data_ptr())
    assert (scores.weights[0], scores.totals[1]) == (None, totals.scores[1].data_ptr())
    assert (fisher.splats, fisher.drawn, fisher.used, fisher.count) == (7, render.drawn, 7, 8)
    assert (scores.scratch is not None) == bool(ordered)
    assert render.flags == 4 | ordered | 1024 | 65536


def test_shared_colours_and_radii(drawn):
    from splatwizard_core.api import SH
    from sw_rasterizers import ops
    from sw_rasterizers.shared_colors import shared_colors

    sh = SH(dc=rand(300, 1, 3, grad=True), codebook=rand(5, 3, 3, grad=True), active_degree=1)
    segments = SimpleNamespace(
        indices=torch.zeros(300, dtype=torch.int64), order=torch.arange(300), offsets=torch.zeros(6, dtype=torch.int64)
    )
    means = rand(300, 3, grad=True)
    colors = shared_colors(sh, segments, means, rand(3), clamp=True)
    grads = torch.autograd.grad(colors, (sh.codebook, sh.dc, means), torch.ones_like(colors))
    assert [grad.shape for grad in grads] == [(5, 3, 3), (300, 1, 3), (300, 3)]
    (back,), (shade,) = drawn["shade_shared_backward"], drawn["shade_shared"]
    assert shade.rows == back.rows
    assert (back.count, back.entries, back.coefficients, back.runs, back.clamp) == (300, 5, 3, 3, 1)
    camera = SimpleNamespace(pose=[0.0] * 12, fx=1, fy=1, cx=0, cy=0, near=0.1, far=9, width=4, height=3)
    assert ops.visible_radii(rand(8, 3), rand(8, 3), rand(8, 4), None, None, camera).shape == (8,)
    assert drawn["visible_radii"][0].scale_columns == 3


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


def test_radii_of_ellipsoids_that_are_alike_are_checked_once(drawn):
    from splatwizard_core.api import Camera, GaussianInputs
    from splatwizard_core.errors import CapabilityError, ShapeError
    from sw_rasterizers.standard import StandardRasterizer

    rasterizer, camera = StandardRasterizer(), Camera(32, 24, 30.0, 30.0, 16.0, 12.0, torch.eye(3), torch.ones(3))
    for rows in (8, 5):
        g = GaussianInputs(rand(rows, 3), rand(rows), rand(rows, 3), rand(rows, 4), colors=rand(rows, 3))
        radii = rasterizer.visible_filter(g, camera)
        call = drawn["visible_radii"][-1]
        assert (call.means, call.quats, call.radii) == (g.means.data_ptr(), g.quats.data_ptr(), radii.data_ptr())
        assert (call.count, call.shapes, len(radii), call.width) == (rows, rows, rows, 32)
        assert (list(call.camera)[9:12], call.eps2d) == ([1, 1, 1], pytest.approx(0.3))
    g.quats = rand(4).expand(5, 4)  # as anchors have them: a copy is handed over
    rasterizer.visible_filter(g, camera)
    assert drawn["visible_radii"][-1].quats != g.quats.data_ptr()
    for scales in (rand(5, 2), rand(4, 3)):
        g.scales = scales
        with pytest.raises((CapabilityError, ShapeError, RuntimeError)):
            rasterizer.visible_filter(g, camera)
