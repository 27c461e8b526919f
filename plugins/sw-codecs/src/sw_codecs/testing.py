"""Checks for any package's tests: they hold a provider to its contract, such as `splatwizard_core.api.ArrayCoder`.

Each takes what is registered and something to code, and raises AssertionError that says what does not hold:

    def test_my_coder_keeps_the_contract():
        check_array_coder(MyCoder, np.arange(12, dtype=np.float32).reshape(4, 3))
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import (
    ArrayCoder,
    BitstreamError,
    ContainerReader,
    ContainerWriter,
    ContextModel,
    EntropyCoder,
    EntropyModel,
    GaussianCodec,
    GaussianModel,
    PositionCodec,
    Quantizer,
    VectorCoder,
)

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

MANY = 100_000
"""Symbols on which an estimated and a real size are compared."""
AGREEMENT = 0.02
"""Largest relative difference of the two."""


@dataclass(frozen=True)
class EntropyCase:
    """Symbols and what an entropy model is given with them.

    symbols     integers or bool, of the shape that the model takes
    context     for `encode`
    training    for `bits`
    decoding    for `decode`
    """

    symbols: np.ndarray
    context: Any
    training: Any
    decoding: Any


def check_damage(
    data: bytes,
    decode: Callable[[bytes], np.ndarray],
    expected: np.ndarray,
    *,
    masks: Sequence[int] = (0x01, 0x80, 0xFF),
    truncations: Iterable[int] | None = None,
) -> None:
    """Hold a decoder to this: cut data is refused, and data with one changed byte is refused or decodes right.

    masks           each is applied to each byte by exclusive or
    truncations     lengths to cut the data to; None: all
    """
    lengths = range(len(data)) if truncations is None else truncations
    for cut in (*(data[:length] for length in lengths), data + b"\x00"):
        try:
            decode(cut)
        except BitstreamError:
            continue
        raise AssertionError(f"{len(cut)} bytes of {len(data)} are decoded")
    for i in range(len(data)):
        for mask in masks:
            changed = bytearray(data)
            changed[i] ^= mask
            try:
                found = decode(bytes(changed))
            except BitstreamError:
                continue
            _hold(np.array_equal(found, expected), f"byte {i} ^ {mask:#x} decodes to something else")


def check_quantizer(
    factory: Callable[..., Quantizer],
    x: Tensor,
    *,
    trained: Quantizer | None = None,
    is_noisy: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Hold a quantizer to `Quantizer`; the decoded values, the symbols, and the side information as a file gives it.

    factory     makes one, without arguments: the decoder
    x           values to quantize, of a shape that it takes
    trained     the encoder; None: as the decoder
    is_noisy    `forward` adds noise, so that its values are not the decoded ones
    """
    quantizer: Quantizer = _made(trained or factory(), Quantizer)
    given = x.clone()
    leaf = x.clone().requires_grad_()
    surrogate = quantizer.forward(leaf)
    _hold(surrogate.shape == x.shape, f"forward gives {list(surrogate.shape)} for {list(x.shape)}")
    surrogate.sum().backward()
    _hold(leaf.grad is not None and bool(torch.isfinite(leaf.grad).all()), "forward has no finite gradient to x")
    symbols, side = quantizer.encode(x)
    again, side_again = quantizer.encode(x)
    _hold(torch.equal(x, given), "forward or encode changes x")
    _hold(symbols.dtype == torch.int64, f"symbols are {symbols.dtype}, must be int64")
    stored = stored_side(side)
    _hold(torch.equal(symbols, again) and _same(stored, stored_side(side_again)), "encode is not repeatable")
    kept = symbols.clone()
    decoded = factory().decode(symbols, stored)
    _hold(torch.equal(symbols, kept), "decode changes the symbols")
    _hold(decoded.dtype == torch.float32, f"decode gives {decoded.dtype}, must be float32")
    _hold(decoded.shape == x.shape, f"decode gives {list(decoded.shape)} for {list(x.shape)}")
    _hold(is_noisy or torch.equal(decoded, surrogate.detach().float()), "decoded values are not those of forward")
    nothing = factory().decode(symbols[:0], stored)
    _hold(len(nothing) == 0, "no symbols decode to values")
    return decoded, symbols, stored


def stored_side(side: Mapping[str, Any]) -> dict[str, Any]:
    """Side information after what a container does to it: arrays as bytes, the rest as JSON."""
    return {
        key: np.frombuffer(value.tobytes(), value.dtype).reshape(value.shape)
        if isinstance(value, np.ndarray | np.generic)
        else json.loads(json.dumps(value))
        for key, value in side.items()
    }


def check_entropy_model(factory: Callable[..., EntropyModel], case: Callable[[int], EntropyCase]) -> None:
    """Hold an entropy model to `EntropyModel`: round trips, truncation, and its estimate against the real size.

    factory     makes one, without arguments: the encoder or the decoder
    case        makes something of about n symbols to code; it is asked for 0, a few, and 100,000
    """
    model: EntropyModel = _made(factory(), EntropyModel)
    for n in (0, 30, MANY):
        each = case(n)
        given = each.symbols.copy()
        data = model.encode(each.symbols, each.context)
        _hold(np.array_equal(each.symbols, given), "encode changes the symbols")
        _hold(data == model.encode(each.symbols, each.context), "encode is not repeatable")
        found = factory().decode(data, each.decoding)
        _hold(found.dtype.kind in "iub", f"decode gives {found.dtype}, must be integers or bool")
        _hold(found.shape == each.symbols.shape, f"decode gives {list(found.shape)} for {list(each.symbols.shape)}")
        _hold(np.array_equal(found, each.symbols), f"{n:,} symbols do not come back")
        if n == 30:
            _refuses_less(factory().decode, data, each.decoding)
        if n == MANY:
            _agrees(model, each, 8 * len(data))


def _agrees(model: EntropyModel, case: EntropyCase, real: int) -> None:
    values = torch.from_numpy(case.symbols.astype(np.int64))
    try:
        bits = model.bits(values.float(), case.training)
    except (ValueError, TypeError):  # of counts: those of integers alone
        bits = model.bits(values, case.training)
    _hold(bits.shape == values.shape, f"bits gives {list(bits.shape)} for {list(values.shape)}")
    estimate = float(bits.detach().double().sum())
    _hold(
        abs(real - estimate) <= AGREEMENT * estimate,
        f"{values.numel():,} symbols take {real:,} bits, estimated were {estimate:,.0f}",
    )


def check_entropy_coder(factory: Callable[..., EntropyCoder], counts: np.ndarray, symbols: np.ndarray) -> None:
    """Hold an entropy coder to `EntropyCoder`.

    counts      [K] of a table of its `specs`
    symbols     [n] integers in 0 .. K - 1
    """
    coder = _made(factory(), EntropyCoder)
    model = coder.specs.Table(counts)
    given = symbols.copy()
    data = coder.encode(symbols, model)
    _hold(np.array_equal(symbols, given), "encode changes the symbols")
    _hold(data == factory().encode(symbols, model), "encode is not repeatable")
    found = factory().decode(data, len(symbols), model)
    _hold(found.dtype == np.int32, f"decode gives {found.dtype}, must be int32")
    _hold(np.array_equal(found, symbols), "symbols do not come back")
    _refuses_less(factory().decode, data, len(symbols), model)
    _hold(coder.encode(symbols[:0], model) == b"", "no symbols take bytes")
    _hold(len(coder.decode(b"", 0, model)) == 0, "no bytes decode to symbols")
    outside = np.full(3, len(counts), symbols.dtype)
    _refuses(ValueError, "a symbol outside the model is coded", coder.encode, outside, model)


def check_position_codec(factory: Callable[..., PositionCodec], points: np.ndarray, bits: int) -> None:
    """Hold a position codec to `PositionCodec`.

    points  [N,3] integers, 0 <= p < 2^bits, in any order
    """
    codec = _made(factory(), PositionCodec)
    order = codec.sort(points)
    _hold(order.dtype == np.int64 and sorted(order.tolist()) == list(range(len(points))), "sort gives no permutation")
    _hold(np.array_equal(codec.sort(torch.from_numpy(points)).numpy(), order), "a tensor is ordered otherwise")
    for some in (points[:0], points[:0].astype(np.int32), points[order]):
        given = some.copy()
        data = codec.encode(some, bits)
        _hold(np.array_equal(some, given), "encode changes the points")
        _hold(data == factory().encode(some, bits), "encode is not repeatable")
        found = factory().decode(data)
        _hold(found.dtype == np.int64, f"decode gives {found.dtype}, must be int64")
        _hold(found.shape == some.shape and np.array_equal(found, some), f"{len(some):,} points do not come back")
        _refuses_less(factory().decode, data)
    _refuses(ValueError, "points out of order are coded", codec.encode, points[order][::-1], bits)
    limited = factory(max_points=len(points) - 1)
    _refuses(BitstreamError, "more points than max_points are decoded", limited.decode, data)


def check_array_coder(factory: Callable[..., ArrayCoder], array: np.ndarray) -> None:
    """Hold a coder of arrays to `ArrayCoder`, for `array` [N, ...] of a dtype that it takes."""
    coder = _made(factory(), ArrayCoder)
    for some in (array, array[:0]):
        given = some.tobytes()
        data = coder.encode(some)
        _hold(some.tobytes() == given, "encode changes the array")
        _hold(data == factory().encode(some), "encode is not repeatable")
        found = factory().decode(data, some.dtype, some.shape)
        _hold(found.dtype == some.dtype.newbyteorder("="), f"decode gives {found.dtype} for {some.dtype}")
        _hold(found.shape == some.shape, f"decode gives {list(found.shape)} for {list(some.shape)}")
        _hold(found.tobytes() == some.astype(found.dtype).tobytes(), "the array does not come back bit for bit")
        _hold(bool(found.flags.writeable), "the decoded array cannot be written")
        _refuses_less(factory().decode, data, some.dtype, some.shape)


def check_vector_coder(
    factory: Callable[..., VectorCoder], plugins: PluginManager, vectors: np.ndarray, **settings: Any
) -> None:
    """Hold a coder of vectors to `VectorCoder`.

    vectors     [n,d] float32
    settings    of the encoder; the decoder is made without
    """
    coder = _made(factory(plugins, **settings), VectorCoder)
    given, importance = vectors.copy(), np.arange(len(vectors), dtype=np.float64)
    n, d = vectors.shape
    parts = coder.encode(vectors, importance)
    _hold(np.array_equal(vectors, given) and bool((np.diff(importance) == 1).all()), "encode changes its arguments")
    _hold(parts == factory(plugins, **settings).encode(vectors, importance), "encode is not repeatable")
    found = factory(plugins).decode(parts, n, d)
    _hold(found.dtype == np.float32, f"decode gives {found.dtype}, must be float32")
    _hold(found.shape == vectors.shape, f"decode gives {list(found.shape)} for {list(vectors.shape)}")
    nothing = coder.encode(vectors[:0], importance[:0])
    _hold(factory(plugins).decode(nothing, 0, d).shape == (0, d), "no vectors do not come back")
    for name, data in parts.items():
        for less in ({key: part for key, part in parts.items() if key != name}, {**parts, name: data[:-1]}):
            if less != parts:
                _refuses(BitstreamError, f"part '{name}' decodes when cut", factory(plugins).decode, less, n, d)


def check_gaussian_codec(
    factory: Callable[..., GaussianCodec], plugins: PluginManager, model: GaussianModel, **settings: Any
) -> GaussianModel:
    """Hold a codec of Gaussians to `GaussianCodec`; the decoded model.

    settings    of the encoder; the decoder is made without
    """
    _made(factory(plugins, **settings), GaussianCodec)
    before, files = model.digest(), []
    for _ in range(2):
        writer = ContainerWriter("conformance", 0)
        writer.static["method"] = {"theirs": 1}
        factory(plugins, **settings).encode(model, writer)
        files.append(writer.to_bytes())
    _hold(model.digest() == before, "encode changes the model")
    _hold(files[0] == files[1], "encode is not repeatable")
    reader = ContainerReader(files[0], "file")
    _hold(reader.static["method"] == {"theirs": 1}, "encode changes header values of the method")
    decoded = factory(plugins).decode(reader)
    _hold(isinstance(decoded, GaussianModel), f"decode gives a {type(decoded).__name__}")
    _hold(factory(plugins).decode(reader).digest() == decoded.digest(), "decode is not repeatable")
    for cut in reader.sections:
        if reader.sections[cut]:
            damaged = ContainerWriter(reader.method, reader.version, raster=reader.raster)
            damaged.static.update(reader.static)
            for name in reader.sections:
                damaged.add(name, reader.section(name)[: -1 if name == cut else None])
            less = ContainerReader(damaged.to_bytes(), "file")
            _refuses(BitstreamError, f"section '{cut}' decodes when cut", factory(plugins).decode, less)
    return decoded


def check_context_model(model: ContextModel, *inputs: Tensor) -> None:
    """Hold a context model to `ContextModel`: its outputs, repeatable, for inputs that stay as they are."""
    _made(model, ContextModel)
    given = [each.clone() for each in inputs]
    outputs = [found if isinstance(found, tuple) else (found,) for found in (model(*inputs), model(*inputs))]
    _hold(all(map(torch.equal, given, inputs)), "the model changes its inputs")
    _hold(all(isinstance(each, Tensor) for each in outputs[0]), "the model gives something else than tensors")
    _hold(all(map(torch.equal, *outputs)), "the model is not repeatable")


def _made(found: Any, contract: Any) -> Any:
    missing = [name for name in dir(contract) if not name.startswith("_") and not hasattr(found, name)]
    _hold(isinstance(found, contract), f"{type(found).__name__} is no {contract.__name__}: it lacks {missing}")
    return found


def _hold(condition: bool, text: str) -> None:
    if not condition:
        raise AssertionError(text)


def _refuses(kind: type[Exception], text: str, act: Callable[..., object], *arguments: Any) -> None:
    try:
        act(*arguments)
    except kind:
        return
    raise AssertionError(text)


def _refuses_less(decode: Callable[..., object], data: bytes, *arguments: Any) -> None:
    """Hold `decode(part, *arguments)` to raise BitstreamError for `data` that is cut, at up to 60 places."""
    for length in sorted({len(data) - 1, *range(0, len(data), max(len(data) // 60, 1))} - {-1, len(data)}):
        text = f"{length:,} of {len(data):,} bytes are decoded"
        _refuses(BitstreamError, text, decode, data[:length], *arguments)


def _same(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)
