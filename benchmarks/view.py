"""Frames a second of the pictures that `sw view` sends, and the seconds to the first one.

    python benchmarks/view.py [--device cuda] [--size 960x540] [--gaussians 20000,1000000] [FILE.swz ...]

A frame is what a browser waits for, less the network: drawn from a camera on a circle around the Gaussians, rounded to
8 bit, copied to the host, and (second figure) encoded as JPEG. Told are the median, the best, and the seconds of all
cores together that a frame takes, which others' work changes least. "moving" is the frame that the viewer chooses while
the camera moves: so many pixels that it takes 1/20 s, unless the Gaussians alone take longer. Gaussians are made up: a
ball of them whose size falls with their number, as in trained scenes, SH degree 3.
"""

from __future__ import annotations

import argparse
import io
import math
import statistics
import time
from pathlib import Path

import torch
from PIL import Image
from sw_view.drawing import Drawing
from sw_view.frames import Pace, frame_size
from sw_view.mode_pictures import mode_picture
from sw_view.packing import solid_means
from sw_view.shown_cameras import Surroundings, surroundings_about, surroundings_of

from splatwizard_core.api import Camera, GaussianModel, Protocol, RasterOptions, Scene, SceneOptions, SplatModel
from splatwizard_core.tooling import NegotiatedRasterizer, PluginManager, load_plugins, load_scene, open_model

SECONDS, MOST_FRAMES = 3.0, 100


def made_up(n: int) -> GaussianModel:
    """Return n Gaussians in a ball of radius 1 that covers itself a few times, whatever n is."""
    draw = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=1)
    means = means * (0.6 + 0.4 * torch.rand(n, 1, generator=draw))
    scales = math.log(1.2 / math.sqrt(n)) + 0.5 * torch.randn(n, 3, generator=draw)
    return GaussianModel(
        means, torch.randn(n, 1, 3, generator=draw), 0.1 * torch.randn(n, 15, 3, generator=draw),
        2 * torch.randn(n, generator=draw), scales, torch.randn(n, 4, generator=draw),
    ).requires_grad_(False)  # fmt: skip


def circle(around: Surroundings, width: int, height: int, steps: int) -> list[Camera]:
    """Return cameras on a circle about the pivot, as far away as the first of `around` is."""
    pivot, up = (torch.from_numpy(v).float() for v in (around.pivot, around.up))
    away = around.cameras[0].camera.center - pivot
    found = []
    for i in range(steps):
        angle = 2 * math.pi * i / steps
        across = torch.linalg.cross(up, away)
        turned = away * math.cos(angle) + across * math.sin(angle) + up * (up @ away) * (1 - math.cos(angle))
        found.append(Camera.look_at(pivot + turned, pivot, up, width=width, height=height, fov_x=math.radians(60)))
    return found


def jpeg(pixels: object) -> int:
    """Return the bytes of a picture as the viewer sends it while the camera moves."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=70)  # type: ignore[arg-type]
    return buffer.tell()


def measure(name: str, model: SplatModel, around: Surroundings, scene: Scene, plugins: PluginManager, args) -> None:
    """Print one row."""
    width, height = map(int, args.size.split("x"))
    device = torch.device(args.device)
    rasterizer = NegotiatedRasterizer(plugins, device=device)
    model = model.to(device)
    began = time.perf_counter()
    drawing = Drawing(model, scene, rasterizer, RasterOptions(background=scene.background.to(device)), device)
    cameras = circle(around, width, height, 24)
    mode_picture(drawing, cameras[0])
    first = time.perf_counter() - began
    rates = []
    for encoded in (False, True):
        seconds: list[float] = []
        cores = time.process_time()
        while len(seconds) < 3 or (sum(seconds) < SECONDS and len(seconds) < MOST_FRAMES):
            began = time.perf_counter()
            pixels = mode_picture(drawing, cameras[len(seconds) % len(cameras)])
            if encoded:
                jpeg(pixels)
            seconds.append(time.perf_counter() - began)
        spent = (time.process_time() - cores) / len(seconds)
        rates.append(f"{1 / statistics.median(seconds):7.1f} (best {1 / min(seconds):6.1f}, {spent:.3f} core s)")
    pace, share = Pace(), 0.5
    for camera in cameras:
        began = time.perf_counter()
        share = pace.of(0.0)
        jpeg(mode_picture(drawing, camera.resized(*frame_size(width, height, share))))
        pace.drew(share, time.perf_counter() - began)
    moving = "x".join(map(str, frame_size(width, height, share)))
    moved = time.perf_counter() - began
    drawn_by = "+".join(sorted(set(rasterizer.drawn_by.values())))
    print(
        f"{name:<24} {model.num_rows:>9,} {args.size:>9}  first {first:6.2f} s   {rates[0]} frames/s   "
        f"with JPEG {rates[1]}   moving {moving} {1 / moved:6.1f}   {drawn_by} on {device}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="encoded scenes to measure besides")
    parser.add_argument("--scene", default="demo", help="scene of the files, for cameras to start from")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--gaussians", default="20000,1000000", help="sizes of made-up models; empty: none")
    args = parser.parse_args()
    plugins = load_plugins()
    for n in (int(text) for text in args.gaussians.split(",") if text):
        model = made_up(n)
        around = surroundings_about(solid_means(model))
        measure("made up", model, around, Scene("none", [], [], None, Protocol("none")), plugins, args)
    for path in args.files:
        model, _ = open_model(path, plugins, torch.device(args.device))
        scene = load_scene(args.scene, SceneOptions(), plugins)
        measure(path.parent.name or path.name, model, surroundings_of(scene), scene, plugins, args)


if __name__ == "__main__":
    main()
