"""Train 3DGS with the public gsplat on a scene of ours: what benchmarks/train_cuda.py measures beside our own trainer.

    python benchmarks/train_gsplat.py DATA/fox --images images_2 --iterations 7000 --seed 0
    python benchmarks/train_gsplat.py DATA/room --iterations 30000 --strategy mcmc
    python benchmarks/train_gsplat.py DATA/room --surfels 1000          # 2DGS, its losses after step 1,000

Loader, split, start points, scene extent and PSNR are those of `sw`; rasterizer and density control are gsplat's with
their default settings. Hyper-parameters are those of 3DGS: means 1.6e-4 to 1.6e-6 times the extent over 30,000 steps,
SH band 0 2.5e-3, the others a twentieth, opacities 0.05, scales 5e-3, quaternions 1e-3, Adam with eps 1e-15, one more
SH degree every 1,000 steps, loss 0.8 L1 + 0.2 (1 - SSIM).

The fastest settings that we know of: packed=False, torch's fused Adam, our fused SSIM ("valid": without padding, as
gsplat's own trainer has it). gsplat 1.5.x tests `== 0 & step > 0` and never resets opacities; this trainer then does
so, as later versions do themselves. --surfels STEP draws 2D Gaussians: after STEP the loss has distortion (mean times
--distortion) and normal consistency against the normals of the expected depth (mean times 0.05), and what is fainter
than 0.05 is pruned from step 600 on, as our method 2dgs does it.

The clock runs in the loop alone; pictures lie on the GPU. Prints a line RESULT {JSON}.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import torch
from sw_gaussians.start import gaussians_from_points
from torch import Tensor, nn

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.training.losses import photometric_loss

MCMC_START = {"opacity": 0.5, "scale": 0.1}  # of all Gaussians; the multiple of the distance to the neighbours
DECAY_STEPS = 30_000
NORMAL_WEIGHT = 0.05
SURFELS = {"key_for_gradient": "gradient_2dgs", "prune_opa": 0.05, "refine_start_iter": 600}
RESET_OPACITY = 2.0  # times the opacity below which the strategy prunes


def parameters(model: GaussianModel, *, mcmc: bool) -> nn.ParameterDict:
    """The start of 3DGS under gsplat's names."""
    opacities, scales = model.opacity_logits.detach(), model.log_scales.detach()
    if mcmc:
        opacities = torch.full_like(opacities, MCMC_START["opacity"]).logit()
        scales = scales + torch.tensor(MCMC_START["scale"]).log()
    found = {
        "means": model.means, "scales": scales, "quats": model.quats, "opacities": opacities,
        "sh0": model.sh_dc, "shN": model.sh_rest,
    }  # fmt: skip
    return nn.ParameterDict({name: nn.Parameter(tensor.detach().clone()) for name, tensor in found.items()})


def matrices(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """(world to camera [1,4,4], K [1,3,3]) as gsplat takes them."""
    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = camera.R, camera.tau
    k = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return view[None].to(device), k[None].to(device)


def surface_loss(drawn: tuple[Tensor, ...], distortion: float) -> Tensor:
    """Normal consistency and distortion of what `rasterization_2dgs` draws, weighted."""
    _, alpha, normals, surface, spread = drawn[:5]
    agreement = (normals * surface * alpha.detach()).sum(dim=-1)
    loss = NORMAL_WEIGHT * (1 - agreement).mean()
    return loss + distortion * spread.mean() if distortion > 0 else loss


def resets(step: int, *, version: str, stop: int, every: int) -> bool:
    """Whether this trainer has to reset opacities after `step` (from 0 on), since gsplat does not."""
    return version.startswith("1.5.") and 0 < step < stop and step % every == 0


def train(args: argparse.Namespace, gsplat: Any, reset: Callable[..., None], device: torch.device) -> dict[str, Any]:
    """Train and measure; the figures of the RESULT line."""
    plugins = load_plugins()
    sets = {"images": args.images} if args.images else {}
    resolved = resolve(plugins.methods.load("3dgs"), "paper", sets=sets, scene=args.scene)
    scene = load_scene(args.scene, resolved.scene, plugins)
    assert scene.points is not None
    mcmc, version = args.strategy == "mcmc", str(gsplat.__version__)
    background = scene.background.to(device)
    p = parameters(gaussians_from_points(scene.points, max_sh_degree=3).to(device), mcmc=mcmc)
    rates = {"means": 1.6e-4 * scene.extent, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3,
             "shN": 1.25e-4}  # fmt: skip
    fused = {"fused": True} if device.type == "cuda" else {}
    optimizers = {
        name: torch.optim.Adam([{"params": p[name], "lr": rate, "name": name}], eps=1e-15, **fused)  # type: ignore[arg-type]
        for name, rate in rates.items()
    }
    surfels = args.surfels is not None
    strategy = gsplat.MCMCStrategy(cap_max=args.cap) if mcmc else gsplat.DefaultStrategy(**SURFELS if surfels else {})
    strategy.check_sanity(p, optimizers)
    state = strategy.initialize_state() if mcmc else strategy.initialize_state(scene_scale=scene.extent)
    train_views, test_views = (
        [(matrices(v.camera, device), v.image(background, device), v.camera) for v in views]
        for views in (scene.train, scene.test)
    )

    rasterize = gsplat.rasterization_2dgs if surfels else gsplat.rasterization

    def draw(
        view: tuple[tuple[Tensor, Tensor], Tensor, Camera], degree: int, **more: Any
    ) -> tuple[Tensor, tuple[Any, ...]]:
        (viewmat, k), _, camera = view
        drawn = rasterize(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat([p["sh0"], p["shN"]], 1),
            viewmat, k, camera.width, camera.height, sh_degree=degree, packed=False, backgrounds=background[None],
            near_plane=camera.near, **more,
        )  # fmt: skip
        return drawn[0][0, ..., :3].permute(2, 0, 1), drawn

    @torch.no_grad()
    def psnr() -> float:
        errors = [(draw(v, 3)[0].clamp(0, 1) - v[1]).square().mean() for v in test_views]
        return float((-10 * torch.stack(errors).log10()).mean())

    measured: dict[int, float] = {}
    generator = torch.Generator().manual_seed(args.seed)
    torch.manual_seed(args.seed)
    order: list[int] = []
    synchronize = torch.cuda.synchronize if device.type == "cuda" else (lambda: None)
    draw(train_views[0], 0)[0].sum().backward()  # loads kernels, outside the clock
    for optimizer in optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    synchronize()
    began = time.perf_counter()
    for step in range(args.iterations):
        order = order or torch.randperm(len(train_views), generator=generator).tolist()
        view = train_views[order.pop()]
        of_surface = surfels and step >= args.surfels
        more = {"render_mode": "RGB+ED", "distloss": args.distortion > 0} if of_surface else {}
        image, drawn = draw(view, min(step // 1000, 3), **more)
        info = drawn[-1]
        if not mcmc:
            strategy.step_pre_backward(p, optimizers, state, step, info)
        loss = photometric_loss(image, view[1], lambda_dssim=0.2, padding=args.padding).total
        if of_surface:
            loss = loss + surface_loss(drawn, args.distortion)
        if mcmc:
            loss = loss + 0.01 * p["opacities"].sigmoid().mean() + 0.01 * p["scales"].exp().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        rate = rates["means"] * 0.01 ** ((step + 1) / DECAY_STEPS)
        optimizers["means"].param_groups[0]["lr"] = rate
        if mcmc:
            strategy.step_post_backward(p, optimizers, state, step, info, lr=rate)
        else:
            strategy.step_post_backward(p, optimizers, state, step, info, packed=False)
        if step + 1 in args.psnr_at:
            measured[step + 1] = psnr()
        if not mcmc and resets(step, version=version, stop=strategy.refine_stop_iter, every=strategy.reset_every):
            value = 0.01 if surfels else strategy.prune_opa * RESET_OPACITY
            reset(params=p, optimizers=optimizers, state=state, value=value)
    synchronize()
    seconds = time.perf_counter() - began
    peak = torch.cuda.max_memory_allocated() / 2**20 if device.type == "cuda" else 0.0
    return {
        "gsplat": version, "plan": "2dgs" if surfels else "3dgs", "strategy": args.strategy,
        "iters": args.iterations, "seed": args.seed, "train_s": seconds,
        "psnr": psnr(), "psnr_at": measured, "n": len(p["means"]), "peak_mib": peak,
        "ssim_impl": f"splatwizard, padding {args.padding}", "reset": "this trainer" if resets(
            1, version=version, stop=2, every=1) else "gsplat", "protocol": scene.protocol.id,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="as --scene of sw")
    parser.add_argument("--images", default="", help="picture folder of a COLMAP scene")
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--strategy", choices=["default", "mcmc"], default="default")
    parser.add_argument("--cap", type=int, default=1_000_000, help="most Gaussians of mcmc (default: 1,000,000)")
    parser.add_argument("--surfels", type=int, metavar="STEP", help="2DGS, losses of the surface after STEP")
    parser.add_argument("--distortion", type=float, default=0.0, help="weight of the distortion (default: 0, no loss)")
    parser.add_argument("--padding", choices=["valid", "same"], default="valid", help="of SSIM in the loss")
    parser.add_argument("--psnr-at", type=int, nargs="*", default=[], metavar="STEP",
                        help="PSNR after these steps too; the plan is the same for any --iterations")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    if args.surfels is not None and args.strategy == "mcmc":
        parser.error("--surfels goes with --strategy default")
    try:
        import gsplat
        from gsplat.strategy.ops import reset_opa
    except ImportError as error:
        raise SystemExit(f"gsplat cannot be imported: {error} (pip install gsplat)") from None
    print("RESULT " + json.dumps(train(args, gsplat, reset_opa, torch.device(args.device))), flush=True)


if __name__ == "__main__":
    main()
