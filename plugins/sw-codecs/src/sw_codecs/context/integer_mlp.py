"""Context model `integer-mlp`: a small ReLU network evaluated exactly, in integers held by float64 tensors.

Any sum of products of integers below 2^53 is exact in float64 whatever the order of summation, with or without fused
multiply-add, on CPU and CUDA, for any batch size. So the probabilities that a decoder derives from the outputs are the
encoder's, to the bit. Source: specification of the codec library, exact mode, rule 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

FRACTION = 12
ACTIVATION_LIMIT = 1 << 20  # 256 in units of 1
WEIGHT_LIMIT = 4096
NUMBERS_AT_ONCE = 1 << 21
"""Of the widest layer, held together."""


class IntegerMlp:
    """Linear layers with ReLU or leaky ReLU between them.

    weights         [(W [out, in], b [out])] float32, as they stand in the file
    leak            slope below zero between the layers, in 1/4096; 0: ReLU
    output_scale    a number or one per output of the last layer: outputs come in units of 1 / output_scale (for
                    HAC: 1 / base step); exact in float64

    Raises ValueError if a weight exceeds 4096 or a sum could reach 2^53.
    """

    def __init__(
        self,
        weights: Sequence[tuple[np.ndarray, np.ndarray]],
        *,
        output_scale: float | np.ndarray = 1.0,
        leak: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.weights = [(np.asarray(w, np.float32), np.asarray(b, np.float32)) for w, b in weights]
        if not self.weights:
            raise ValueError("a network needs at least one layer")
        self._leak = leak
        integers: list[np.ndarray] = []
        width = self.weights[0][0].shape[-1]
        for i, (w, b) in enumerate(self.weights):
            if w.ndim != 2 or b.shape != w.shape[:1] or w.shape[1] != width:
                raise ValueError(
                    f"layer {i}: weight {list(w.shape)} and bias {list(b.shape)} do not fit {width} inputs"
                )
            width = w.shape[0]
            scale = np.asarray(output_scale if i == len(self.weights) - 1 else 1.0, np.float64)
            scale = np.broadcast_to(scale, (width,))
            wq = np.rint(w.astype(np.float64) * scale[:, None] * 2.0**FRACTION)
            bq = np.rint(b.astype(np.float64) * scale * 2.0 ** (2 * FRACTION))
            if not (np.isfinite(wq).all() and np.isfinite(bq).all()) or np.abs(w).max(initial=0) > WEIGHT_LIMIT:
                raise ValueError(f"layer {i}: a weight is not finite or exceeds {WEIGHT_LIMIT}")
            if (np.abs(wq).sum(1) * ACTIVATION_LIMIT + np.abs(bq)).max(initial=0) >= 2.0**53:
                raise ValueError(f"layer {i}: sums could reach 2^53 and would not be exact")
            integers += [wq, bq]
        self._flat = torch.from_numpy(np.concatenate([each.reshape(-1) for each in integers])).to(device)
        parts = iter(self._flat.split([each.size for each in integers]))
        self._layers = [(next(parts).view(w.shape), next(parts)) for w, _ in self.weights]
        self.widths = torch.tensor([self.weights[0][0].shape[1], *(len(b) for _, b in self.weights)])  # and of inputs

    @classmethod
    def from_module(cls, module: nn.Module, *, output_scale: float | np.ndarray = 1.0) -> IntegerMlp:
        """From nn.Sequential of Linear and ReLU in turn. Raises ValueError for anything else."""
        weights, parts = [], list(module.children())
        for i, part in enumerate(parts):
            if i % 2 == 0 and isinstance(part, nn.Linear) and part.bias is not None:
                weights.append((part.weight.detach().cpu().numpy(), part.bias.detach().cpu().numpy()))
            elif not (i % 2 == 1 and isinstance(part, nn.ReLU) and i < len(parts) - 1):
                raise ValueError(f"part {i} is {type(part).__name__}: Linear and ReLU must take turns, Linear last")
        device = next(module.parameters()).device if weights else "cpu"
        return cls(weights, output_scale=output_scale, device=device)

    def state(self) -> dict[str, np.ndarray]:
        """The float32 arrays that go into the file: weight0, bias0, weight1, ..."""
        found = {}
        for i, (w, b) in enumerate(self.weights):
            found[f"weight{i}"], found[f"bias{i}"] = w, b
        return found

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray], *, output_scale: float | np.ndarray = 1.0) -> IntegerMlp:
        """From what `state` gave. Raises BitstreamError if the arrays make no exact network."""
        try:
            weights = [(state[f"weight{i}"], state[f"bias{i}"]) for i in range(len(state) // 2)]
            return cls(weights, output_scale=output_scale)
        except (KeyError, ValueError) as error:
            raise BitstreamError(f"the context network cannot be used: {error}") from error

    @property
    def outputs(self) -> int:
        """Width of the last layer."""
        return len(self._layers[-1][1])

    def __call__(
        self, inputs: Tensor, further: Tensor | None = None, *, rows: int | None = None, out: Tensor | None = None
    ) -> Tensor:
        """int64 [n, out] with 12 fractional bits, in units of 1 / output_scale.

        inputs  [n, in] integers with 12 fractional bits, clamped to +-2^20 (that is 256)
        further [n, m] inputs behind them, which then are [n, in - m]
        rows    how many are evaluated at once, None: by the widest layer; the result does not depend on it
        out     contiguous int64 [n, out] to write into, on the device of the inputs
        """
        parts = [inputs] if further is None else [inputs, further]
        width = self._layers[0][0].shape[1]
        if any(p.ndim != 2 or p.is_floating_point() for p in parts) or sum(p.shape[1] for p in parts) != width:
            raise ValueError(f"inputs must be integers [n, {width}], not {[list(p.shape) for p in parts]}")
        if rows is None and inputs.device.type == self._layers[0][0].device.type == "cpu" and EXACT.try_load():
            found = torch.empty(len(inputs), self.outputs, dtype=torch.int64) if out is None else out
            parts = parts if further is None else [p.to(torch.int64) for p in parts]
            exact_operations.network([for_kernel(p) for p in parts], self._flat, self.widths, self._leak, found)
            return found
        inputs = torch.cat(parts, dim=1)
        rows = rows or NUMBERS_AT_ONCE // max(max(w.shape) for w, _ in self._layers)
        found = torch.cat([self._evaluate(block) for block in inputs.split(max(rows, 1))])
        return found if out is None else out.copy_(found)

    def flat(self) -> Tensor:
        """Integers of all weights [out, in] and biases [out], layer by layer, float64 [P]."""
        return self._flat

    def _evaluate(self, inputs: Tensor) -> Tensor:
        device = self._layers[0][0].device
        a = inputs.to(device, torch.float64).clamp(-ACTIVATION_LIMIT, ACTIVATION_LIMIT)
        for i, (w, b) in enumerate(self._layers):
            a = ((a @ w.T + b) / 2.0**FRACTION).floor()
            if i < len(self._layers) - 1:
                low = -ACTIVATION_LIMIT if self._leak else 0
                a = torch.where(a < 0, (a * (self._leak / 2.0**FRACTION)).floor(), a).clamp(low, ACTIVATION_LIMIT)
        return a.to(torch.int64).to(inputs.device)


def for_kernel(inputs: Tensor) -> Tensor:
    """int16, or int64 with rows that have no gaps."""
    inputs = inputs if inputs.dtype == torch.int16 else inputs.to(torch.int64)
    return inputs if inputs.dtype == torch.int64 and inputs.stride(1) == 1 else inputs.contiguous()


def to_fixed(values: np.ndarray) -> np.ndarray:
    """Floats as int64 with 12 fractional bits. For values both sides hold bit for bit (decoded ones), never for
    outputs of a float network."""
    return np.rint(np.asarray(values, np.float64) * 2.0**FRACTION).astype(np.int64)
