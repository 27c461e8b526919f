"""The base of all scene models: parameters, and how they become Gaussians."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.scene.camera import Camera

if TYPE_CHECKING:
    from splatwizard_core.rendering.rasterizer import Rasterizer


def finite_rows(values: Tensor) -> Tensor:
    """Whether each row of [N,...] is finite; some at a time, since what is found on the way is larger than they are."""
    rows = torch.split(values.detach().unsqueeze(-1).flatten(1), 1 << 16)
    return torch.cat([part.isfinite().all(dim=1) for part in rows])


class SplatModel(nn.Module):
    """Parameters and mathematics of a scene; knows nothing of optimizers, schedules or files.

    A renderer needs one thing of it: `gaussians(camera, rasterizer)`. Per-primitive parameters and buffers
    (one row per Gaussian or anchor) are named in `ROWS`, so that densification and pruning can add and remove
    rows of all of them together, whatever the model is.
    """

    ROWS: tuple[str, ...] = ()
    """Names of the parameters and buffers whose first dimension is the primitive; attributes of the model."""
    ROW_LABEL: ClassVar[str] = "gaussians"
    """The primitives' name in progress and messages, plural; a model of anchors says "anchors"."""
    origin: Mapping[str, Any] = {}
    """Facts that the reader of its file tells; `raster` in them: options that it asks of a rasterizer."""

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """The activated Gaussians that `camera` sees; differentiable with respect to the parameters.

        rasterizer  for a visibility pre-filter (`rasterizer.visible_filter`), nothing else
        What losses and tasks want to see again goes into `GaussianInputs.extras`.
        """
        raise NotImplementedError

    @property
    def num_rows(self) -> int:
        """Number of primitives that the model stores (`ROW_LABEL` names them)."""
        return int(getattr(self, self.ROWS[0]).shape[0])

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def counts(self) -> dict[str, int]:
        """The counts that a record reports: {"num_gaussians": ...}; other models add those of their primitives."""
        return {"num_gaussians": self.num_rows}

    def prepare(self) -> None:
        """Build caches that no view changes, once, before rendering a decoded model. Default: nothing."""

    def state_dict_extra(self) -> dict[str, Any]:
        """JSON-able state that is not a tensor: the active SH degree, mode flags. Part of every checkpoint."""
        return {}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        """Inverse of `state_dict_extra`."""

    def load_resized(self, state: dict[str, Tensor]) -> None:
        """Load a state whose row counts differ from the model's: tensors take the shapes of the state."""
        for name, value in state.items():
            owner_name, _, leaf = name.rpartition(".")
            owner = self.get_submodule(owner_name)
            current = getattr(owner, leaf, None)
            if isinstance(current, Tensor) and current.shape == value.shape:
                continue
            fresh = torch.empty_like(value, device=current.device if isinstance(current, Tensor) else None)
            if isinstance(current, nn.Parameter):
                setattr(owner, leaf, nn.Parameter(fresh, requires_grad=current.requires_grad))
            else:
                owner.register_buffer(leaf, fresh)
        self.load_state_dict(state)

    def non_finite_rows(self) -> int:
        """Number of primitives with a value that is NaN or infinite: rasterizers leave them out."""
        bad = torch.zeros(self.num_rows, dtype=torch.bool, device=self.device)
        for value in (getattr(self, name) for name in self.ROWS):
            if value.is_floating_point():
                bad |= ~finite_rows(value)
        return int(bad.sum())

    def check_finite(self) -> int:
        """`non_finite_rows`. Raises SplatwizardError if that is all of them: nothing would be drawn."""
        if (bad := self.non_finite_rows()) and bad == self.num_rows:
            raise SplatwizardError(f"all {bad:,} {self.ROW_LABEL} of the model hold values that are not finite")
        return bad

    def digest(self) -> str:
        """SHA-256 over names, shapes and bytes of all parameters and buffers, and the extra state."""
        sha = hashlib.sha256(json.dumps(self.state_dict_extra(), sort_keys=True).encode())
        for name, tensor in sorted(self.state_dict().items()):
            sha.update(f"{name}{tuple(tensor.shape)}{tensor.dtype}".encode())
            if tensor.numel():  # an empty tensor cannot be seen as bytes
                sha.update(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
        return sha.hexdigest()

    def parameter_hash(self) -> str:
        """SHA-256 of the parameters alone, as decoders in any language compute it (docs/bitstream.md, chapter 7)."""
        first = ["means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"]  # then all others by name
        found = dict(self.named_parameters())
        names = sorted(found, key=lambda name: (first.index(name) if name in first else len(first), name))
        parts = (found[name].detach().cpu().numpy().astype("<f4").tobytes() for name in names)
        return hashlib.sha256(b"".join(parts)).hexdigest()
