"""Reproducible synthetic splat scenes and cameras for rasterizer benchmarks.

`make_splats(n)` draws n Gaussians that look like a trained unbounded capture: clustered, thin, anisotropic splats on
object surfaces (60 %), a ground disc (20 %) and a far shell (20 %), log-normal scales that shrink with 1/sqrt(n),
bimodal opacities, SH colours of degree 3. `orbit_cameras(k, width, height)` look at the origin.

Everything is drawn in float64 from PCG64 in the order written here and cast to float32 at the end, so (n, seed) fixes
every value. World: y points down. Values are activated: scales in world units, opacities in (0, 1), unit quaternions.

    python benchmarks/scene.py --n 1000000      prints the statistics that describe a scene
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch

from splatwizard_core.api import SH, SH_C0, Camera, GaussianInputs

SEED = 7
PATCHES = 300  # surface patches of the object
SCALE_1M = 0.0085  # median of the largest axis at n = 1M on object and ground, world units
SIGMA_COMMON = 0.75  # log-std shared by the three axes of a Gaussian
SIGMA_AXIS = 0.45  # log-std of each axis on top of it
THIN = 0.25  # the third axis is shorter by this factor: splats are flat
OPAQUE = 0.35  # share of the opaque mode, Beta(6, 0.7); the rest is Beta(0.7, 4)
OPACITY_MIN = 0.006  # trained models prune below 0.005
HFOV = 62.0  # degrees
ORBIT_RADIUS = 4.0
ORBIT_HEIGHT = 1.3


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def make_arrays(n: int, seed: int = SEED, sh_degree: int = 3) -> dict[str, np.ndarray]:
    """float32 arrays: means [n,3], quats [n,4], scales [n,3], opacities [n], sh [n,K,3]."""
    r = np.random.default_rng(seed)
    n_object, n_ground = int(0.6 * n), int(0.2 * n)
    n_far = n - n_object - n_ground

    centre = r.normal(size=(PATCHES, 3)) * [1.1, 0.45, 1.1]
    extent = np.exp(r.uniform(math.log(0.05), math.log(0.45), (PATCHES, 3)))
    extent[:, 2] *= 0.04
    rotation = np.linalg.qr(r.normal(size=(PATCHES, 3, 3)))[0]
    weight = r.dirichlet(np.full(PATCHES, 0.7))
    patch = r.choice(PATCHES, n_object, p=weight)
    local = r.normal(size=(n_object, 3)) * extent[patch]
    on_object = centre[patch] + np.einsum("nij,nj->ni", rotation[patch], local)

    # A disc of radius 6 at y = 0.9 with a little relief.
    radius, angle = 6.0 * np.sqrt(r.random(n_ground)), 2 * math.pi * r.random(n_ground)
    ground = np.stack([radius * np.cos(angle), 0.9 + 0.03 * r.normal(size=n_ground), radius * np.sin(angle)], -1)

    # Mostly above the ground, log-normal distance.
    direction = _unit(r.normal(size=(n_far, 3)))
    direction[:, 1] = -np.abs(direction[:, 1]) + 0.15
    distance = 9.0 * np.exp(0.45 * r.normal(size=(n_far, 1)))
    far = _unit(direction) * distance

    means = np.concatenate([on_object, ground, far])
    grow = np.concatenate([np.ones(n_object), np.ones(n_ground), 0.45 * distance[:, 0]])
    log_scales = SIGMA_COMMON * r.normal(size=(n, 1)) + SIGMA_AXIS * r.normal(size=(n, 3))
    scales = SCALE_1M * math.sqrt(1e6 / n) * grow[:, None] * np.exp(log_scales) * [1.0, 0.7, THIN]
    quats = _unit(r.normal(size=(n, 4)))
    opacities = np.where(r.random(n) < OPAQUE, r.beta(6.0, 0.7, n), r.beta(0.7, 4.0, n))
    opacities = np.clip(opacities, OPACITY_MIN, 0.999)
    sh = r.normal(size=(n, (sh_degree + 1) ** 2, 3), scale=0.04)
    sh[:, 0] = (r.beta(1.6, 2.2, (n, 3)) - 0.5) / SH_C0

    order = r.permutation(n)
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    return {name: np.ascontiguousarray(a[order], dtype=np.float32) for name, a in arrays.items()}


def make_splats(n: int, *, seed: int = SEED, requires_grad: bool = False) -> GaussianInputs:
    """The scene as rasterizer inputs, SH split into dc and rest, as models store it."""
    t = {name: torch.from_numpy(a) for name, a in make_arrays(n, seed).items()}
    dc, rest = t["sh"][:, :1].contiguous(), t["sh"][:, 1:].contiguous()
    g = GaussianInputs(t["means"], t["opacities"], t["scales"], t["quats"], sh=SH(dc=dc, rest=rest))
    for x in g.tensors().values():
        x.requires_grad_(requires_grad)
    return g


def orbit_cameras(k: int, width: int, height: int, hfov: float = HFOV) -> list[Camera]:
    """k views on a circle around the origin."""
    focal = 0.5 * width / math.tan(math.radians(hfov) / 2)
    cameras = []
    for i in range(k):
        a = 2 * math.pi * i / k
        position = np.array([ORBIT_RADIUS * math.sin(a), -ORBIT_HEIGHT, -ORBIT_RADIUS * math.cos(a)])
        z = _unit(-position)
        x = _unit(np.cross([0.0, 1.0, 0.0], z))
        R = np.stack([x, np.cross(z, x), z])
        R_, tau = (torch.from_numpy(v.astype(np.float32)) for v in (R, -R @ position))
        cameras.append(Camera(width, height, focal, focal, width / 2, height / 2, R_, tau))
    return cameras


def main() -> None:
    from splatwizard_core.api import RasterOptions
    from sw_rasterizers.standard import StandardRasterizer

    parser = argparse.ArgumentParser(description="Statistics of a benchmark scene.")
    parser.add_argument("--n", type=int, default=1_000_000, help="Gaussians")
    parser.add_argument("--size", default="1237x822", help="image, WIDTHxHEIGHT")
    parser.add_argument("--views", type=int, default=8)
    arguments = parser.parse_args()
    width, height = (int(v) for v in arguments.size.split("x"))
    g = make_splats(arguments.n)
    levels = torch.tensor([0.05, 0.25, 0.5, 0.75, 0.95])
    print("opacity quantiles 5..95 %", torch.quantile(g.opacities, levels).tolist())
    rasterizer = StandardRasterizer(count=True)
    for i, camera in enumerate(orbit_cameras(arguments.views, width, height)):
        result = rasterizer.render(g, camera, RasterOptions())
        s = result.stats
        assert s.n_pairs is not None
        assert s.n_visible is not None
        radii = result.radii[result.visible].float()
        print(
            f"view {i}: visible {s.n_visible / len(g):.3f}, pairs {s.n_pairs}, tiles/visible "
            f"{s.n_pairs / max(1, s.n_visible):.2f}, blended {s.n_blended}, radius px median {radii.median():.0f}"
        )


if __name__ == "__main__":
    main()
