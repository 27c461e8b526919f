"""Drawing, loss and gradients of a training step in one, the drawing and the photometric loss outside of autograd.

The kernels, and so the numbers, are those of `Rasterizer.render`, the stage's loss and autograd: what is spared is the
time of the host, more than half a millisecond a step, which a GPU would wait for.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, runtime_checkable

import torch
from torch import Tensor

from splatwizard_core.api import SH, Feature, GaussianInputs, GaussianModel, LossPack, RasterOptions, RenderResult
from splatwizard_native import photometric_gradient

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer, SplatModel, TrainingState, View
    from sw_gaussians.config import Loss

Terms = Callable[[LossPack, RenderResult], LossPack]
"""Adds the further terms of a loss."""


@runtime_checkable
class Draws(Protocol):
    """A rasterizer that draws unknown to autograd.

    draw    the result, and what gives, once, from the gradient of the image those of all inputs, by name (sh_dc, ...),
            but for those whose offered update is done then. Maps of the result are leaves, whose gradients it adds
    """

    def draw(
        self, g: GaussianInputs, cam: Camera, opt: RasterOptions
    ) -> tuple[RenderResult, Callable[[Tensor], dict[str, Tensor]]]: ...


@runtime_checkable
class Chooses(Protocol):
    """A rasterizer that delegates: `served` are the names of those that have drawn."""

    served: set[str]

    def decided(self, opt: RasterOptions) -> RasterOptions: ...

    def select(self, required: Iterable[str]) -> Rasterizer: ...


class WholeStep:
    """Takes the whole step where everything is plain; remembers who draws with the options of the last step."""

    def __init__(self) -> None:
        self._asked: tuple[Rasterizer, RasterOptions] | None = None
        self._found: tuple[Draws, RasterOptions] | None = None
        self._weights: tuple[list[float], Tensor] | None = None

    def __call__(
        self,
        asked: Callable[[], RasterOptions],
        settings: Loss,
        state: TrainingState,
        view: View,
        camera: Camera,
        background: Tensor,
        terms: Terms | None = None,
    ) -> tuple[RenderResult, LossPack] | None:
        """Do what `Stage.whole_step` says, with these options and this loss; None where it cannot.

        terms   those of the maps: they have no gradient by what was drawn
        """
        model = state.model
        if not is_plain(model) or not torch.is_grad_enabled():
            return None
        params: dict[str, Any] = model._parameters
        sh_rest, truth = params["sh_rest"], view.image(background, params["means"].device)
        if not _fits(truth, camera):
            return None
        sh = SH(dc=params["sh_dc"], rest=sh_rest if sh_rest.shape[1] else None, active_degree=model.active_sh_degree)
        options = asked()
        with torch.no_grad():
            scales, opacities = model.scales, model.opacities
            g = GaussianInputs(params["means"], opacities, scales, params["quats"], sh=sh)
            found = self._drawer(state.rasterizer, g, options)
            if found is None:
                return None
            result, gradients = found[0].draw(g, camera, found[1])
            loss = photometric_gradient(result.image, truth, settings.lambda_dssim, settings.ssim_padding)
            if loss is None:
                return None
            total, l1, similarity, by_image = loss
            pack = LossPack(total, {"l1": l1, "ssim": similarity})
        if terms is not None:
            pack = terms(pack, result)
            if pack.total.requires_grad:
                run_backward((pack.total,), (torch.ones_like(pack.total, requires_grad=False),))
        with torch.no_grad():
            by = gradients(by_image)
            by["log_scales"] = by["scales"].mul_(scales)
            by["opacity_logits"] = torch.ops.aten.sigmoid_backward(by["opacities"], opacities)
        for name, param in params.items():
            param.grad = by.get(name)
        return result, pack

    def through(
        self,
        g: GaussianInputs,
        options: RasterOptions,
        lambda_dssim: float,
        state: TrainingState,
        view: View,
        camera: Camera,
        background: Tensor,
        terms: Callable[[RenderResult, dict[str, Tensor]], Mapping[str, tuple[float, Tensor]]],
    ) -> tuple[RenderResult, LossPack] | None:
        """Do the same for Gaussians that autograd knows, with colours of their own; None where it cannot.

        terms   weights and scalars by name, whose products the loss has besides; those that autograd does not know
                have added theirs to the gradients of the inputs by name
        """
        truth = view.image(background, g.means.device)
        if not _fits(truth, camera) or g.sh is not None or g.means.dtype != torch.float32:
            return None
        found = self._drawer(state.rasterizer, g, options)
        if found is None:
            return None
        with torch.no_grad():
            result, gradients = found[0].draw(g, camera, found[1])
            loss = photometric_gradient(result.image, truth, lambda_dssim)
            if loss is None:
                return None
            total, l1, similarity, by_image = loss
            by = gradients(by_image)  # the GPU works while the host puts the terms together
        parts, further = {"l1": l1, "ssim": similarity}, terms(result, by)
        weights = self._weights_of(further, total)
        if further:
            with torch.no_grad():
                weighted = torch.stack([total, *(term for _, term in further.values())]) * weights
                total = weighted.sum()
            parts |= dict(zip(further, weighted[1:].unbind(), strict=True))
        pairs = [(x, by[name]) for name in by if (x := getattr(g, name, None)) is not None]
        pairs += [(term, w.to(term.dtype)) for (_, term), w in zip(further.values(), weights[1:], strict=True)]
        learning = [(x, slope) for x, slope in pairs if x.requires_grad]
        run_backward(tuple(x for x, _ in learning), tuple(slope for _, slope in learning))
        return result, LossPack(total, parts)

    def _weights_of(self, terms: Mapping[str, tuple[float, Tensor]], like: Tensor) -> Tensor:
        """Return 1 and the weights of terms in one tensor, that of the last step where they are the same."""
        weights = [1.0, *(weight for weight, _ in terms.values())]
        if self._weights is None or self._weights[0] != weights or self._weights[1].device != like.device:
            self._weights = weights, like.new_tensor(weights)
        return self._weights[1]

    def _drawer(
        self, rasterizer: Rasterizer, g: GaussianInputs, opt: RasterOptions
    ) -> tuple[Draws, RasterOptions] | None:
        """Return who draws, and with which options; only who has drawn before: `render` finds out who cannot."""
        if self._found is not None and self._asked == (rasterizer, opt):
            return self._found
        self._asked, self._found, chosen = (rasterizer, opt), None, rasterizer
        if isinstance(rasterizer, Chooses):
            opt = rasterizer.decided(opt)
            profile = {f"profile {opt.profile}"} if opt.profile else frozenset()
            with torch.enable_grad():
                chosen = rasterizer.select(Feature.asked_by(opt, g).names | profile)
            if chosen.info.name not in rasterizer.served:
                return None
        if isinstance(chosen, Draws):
            self._found = chosen, opt
        return self._found


def is_plain(model: SplatModel) -> TypeGuard[GaussianModel]:
    """Whether it is drawn as a GaussianModel, and its parameters all learn, without gradient yet and without hooks."""
    return (
        _is_drawn_plainly(type(model))
        and model._parameters.keys() == set(model.RAW)
        and all(
            p is not None
            and p.requires_grad
            and p.grad is None
            and p.dtype is torch.float32
            and p.is_contiguous()
            and not p._backward_hooks
            for p in model._parameters.values()
        )
    )


@functools.cache
def _is_drawn_plainly(kind: type) -> bool:
    drawn = "gaussians", "scales", "opacities"
    return issubclass(kind, GaussianModel) and all(getattr(kind, x) is getattr(GaussianModel, x) for x in drawn)


def _fits(truth: Tensor, camera: Camera) -> bool:
    return truth.shape == (3, camera.height, camera.width) and truth.dtype == torch.float32 and not truth.requires_grad


def run_backward(roots: tuple[Tensor, ...], slopes: tuple[Tensor, ...]) -> None:
    """Run autograd as `torch.autograd.backward` does, which would import sympy to compare the shapes."""
    engine: Any = torch.autograd.Variable._execution_engine
    engine.run_backward(roots, slopes, False, False, (), allow_unreachable=True, accumulate_grad=True)
