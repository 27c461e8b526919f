"""Time of calls of native operations from Python, small and large, beside those of another checkout.

    python benchmarks/native_calls.py [--against CHECKOUT] [--rounds 5] [--threads 1] [--only adam]

Each checkout runs in a process of its own on its own sources; they take turns, so that a busy machine slows both alike.
Microseconds are the minimum over all rounds; "x" is the time of the other checkout over ours (above 1: ours is faster).
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

HERE = Path(__file__).resolve().parents[1]


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and call of each case; what checkouts share is used alone."""
    yield from training_cases()
    yield from exact_cases()
    yield from codec_cases()


def training_cases() -> Iterator[tuple[str, Callable[[], object]]]:
    import torch
    from sw_gaussians.sparse_adam import sparse_adam_steps

    from splatwizard_native import AdamUpdate, adam_steps, photometric

    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    for count in (1, 100, 10_000, 200_000):  # Gaussians, of six tensors with 59 numbers
        shapes = [(count, columns) for columns in (3, 3, 45, 1, 3, 4)]
        updates = [AdamUpdate(*(rand(*s) for _ in range(4)), 1e-3, 0.9, 0.999, 1e-15, 10) for s in shapes]
        yield f"adam of {count:,} Gaussians", lambda updates=updates: adam_steps(updates)
        rows = rand(count) < 0.4
        yield (f"sparse adam of {count:,} Gaussians",
               lambda updates=updates, rows=rows: sparse_adam_steps(updates, rows))  # fmt: skip
    for height, width in ((16, 16), (135, 240), (540, 960)):
        image, target = rand(3, height, width).requires_grad_(), rand(3, height, width)

        def loss(image: torch.Tensor = image, target: torch.Tensor = target) -> None:
            image.grad = None
            photometric(image, target, 0.2)[0].backward()

        yield f"photometric {width} x {height}, forward and backward", loss
    yield from drawings()
    yield from of_anchors(rand)


def drawings() -> Iterator[tuple[str, Callable[[], object]]]:
    """Forward and backward passes of rasterizers, and scores."""
    import torch
    from scene import make_splats, orbit_cameras

    from splatwizard_core.api import RasterOptions, ScoreSpec
    from sw_rasterizers.standard import StandardRasterizer
    from sw_rasterizers.surfel import SurfelRasterizer

    for count, width, height in ((10, 32, 32), (1000, 64, 64), (10_000, 240, 135), (100_000, 480, 270)):
        g, camera = make_splats(count, requires_grad=True), orbit_cameras(8, width, height)[0]
        surfels = copy.copy(g)
        surfels.scales = g.scales.detach()[:, :2].clone().requires_grad_()
        options = RasterOptions(grad2d=True)
        scores = RasterOptions(scores=(ScoreSpec("hits", "hits"), ScoreSpec("grad", "grad_sq")))

        def draw(g=g, camera=camera, kind=StandardRasterizer, options=options) -> None:
            for x in g.tensors().values():
                x.grad = None
            kind().render(g, camera, options).image.sum().backward()

        def look(g=g, camera=camera) -> None:
            with torch.no_grad():
                StandardRasterizer().render(g, camera, RasterOptions())

        of = f"{count:,} Gaussians, {width} x {height}"
        yield f"drawing {of}, forward and backward", draw
        yield f"drawing {of}, forward alone", look
        yield f"drawing {of}, surfels", lambda draw=draw, surfels=surfels: draw(surfels, kind=SurfelRasterizer)
        yield (
            f"drawing {of}, scores",
            lambda g=g, camera=camera, scores=scores: StandardRasterizer().accumulate(g, [camera], scores),
        )


def exact_cases() -> Iterator[tuple[str, Callable[[], object]]]:
    import numpy as np
    import torch

    from sw_cat_3dgs.triplane import Triplane
    from sw_codecs.context.integer_mlp import IntegerMlp
    from sw_codecs.entropy import exact_streams
    from sw_codecs.entropy.lattice import lattice

    draw = np.random.default_rng(0)
    layers = [(draw.normal(0, 0.1, (o, i)).astype("f4"), np.zeros(o, "f4")) for i, o in ((48, 64), (64, 64))]
    network = IntegerMlp(layers)
    planes = [torch.from_numpy(draw.integers(-50, 50, (3, 24, size, size))) for size in (32, 64)]
    look_up = Triplane.exact_lookup(planes)
    for rows in (1, 100, 10_000):
        mean, scale = draw.integers(-(1 << 16), 1 << 16, (rows, 10)), draw.integers(0, 1 << 15, (rows, 10))
        step = draw.integers(64, 16384, (rows, 1))
        centre, number = lattice(mean, scale, step)
        symbols = (centre + draw.normal(0, 3, len(centre)).round()).astype(np.int32)
        data = exact_streams.encode("gaussian", symbols, centre, number)
        inputs = torch.from_numpy(draw.integers(-5000, 5000, (rows, 48)))
        places = torch.from_numpy(draw.integers(0, 1 << 20, (rows, 3)))
        yield f"lattice of {rows:,} x 10", lambda m=mean, s=scale, t=step: lattice(m, s, t)
        at = (centre, number)
        yield (
            f"exact streams, {10 * rows:,} symbols, encode",
            lambda s=symbols, at=at: exact_streams.encode("gaussian", s, *at),
        )
        yield (
            f"exact streams, {10 * rows:,} symbols, decode",
            lambda d=data, at=at: exact_streams.decode("gaussian", d, *at),
        )
        yield f"integer network, {rows:,} rows", lambda x=inputs: network(x)
        yield f"integer triplane, {rows:,} places", lambda x=places: look_up(x)


def codec_cases() -> Iterator[tuple[str, Callable[[], object]]]:
    import numpy as np
    import torch

    from sw_codecs.codebooks.fast.boxes import search_by_boxes
    from sw_codecs.coders.huffman import HuffmanCoder
    from sw_codecs.coders.model_spec import Table
    from sw_codecs.native import CODECS
    from sw_hac.mixed_grid import MixedHashGrid

    CODECS.load()
    generator = torch.Generator().manual_seed(0)
    grid = MixedHashGrid((18, 33, 59), (130, 258), features=4, log2_space=13, generator=generator)
    draw = np.random.default_rng(0)
    entries = torch.rand(4096, 3, generator=generator)
    for rows in (1, 100, 20_000):
        x = torch.rand(rows, 3, generator=generator)

        def sample(x: torch.Tensor = x) -> None:
            grid.with_bits(x)[0].sum().backward()

        yield f"signs of {rows:,} places, forward and backward", sample
        search = search_by_boxes(x, entries)
        if search is not None:
            yield f"nearest entries of {rows:,} rows", lambda x=x, search=search: search(x, 0)
        spec = Table(np.array([5, 3, 2, 1]))
        data = HuffmanCoder().encode(draw.integers(0, 4, rows), spec)
        yield f"{rows:,} Huffman codes, decode", lambda d=data, n=rows, spec=spec: HuffmanCoder().decode(d, n, spec)


def of_anchors(rand: Callable[..., torch.Tensor]) -> Iterator[tuple[str, Callable[[], object]]]:
    """Cases of anchors, forward and backward: what a step of HAC++ calls."""
    import torch
    from sw_anchors.fast import noisy_values, sample_bits, spawn
    from sw_anchors.fast.predicted_steps import predicted_steps
    from sw_anchors.noisy_values import Noise

    from sw_codecs.context.two_layers import two_layers
    from sw_hac.fast import predicted_bits

    k, width = 10, 50
    generator = torch.Generator().manual_seed(0)
    networks = tuple(two_layers(width + 4, width, out * k, generator) for out in (1, 7, 3))
    for count in (10, 1_000, 20_000):  # anchors
        tables = [rand(count, *shape).sub_(0.5).requires_grad_() for shape in ((width,), (6,), (k, 3), (k,))]
        features, scales, offsets, _ = tables
        positions, rows, sample = rand(count, 3), torch.arange(count), torch.arange(0, count, 20)
        noise = Noise(rand(count, 3), rand(count, width + 6 + 3 * k))
        layers = [rand(*shape).requires_grad_() for shape in ((100, width), (100,), (3, 100), (3,))]
        numbers, masks, counted = width + 6 + 3 * k, torch.ones(len(sample), k), torch.ones(len(sample))
        x, mean, scale = (rand(len(sample), numbers).requires_grad_() for _ in range(3))
        outputs = rand(len(sample), 2 * numbers).requires_grad_()
        read = predicted_bits.Predicted(torch.ones(2 * numbers), 1.0, 1e-6, 1e-9, 0.0, predicted_bits.MaskKind.GATED)
        steps = rand(len(sample), 3) + 0.5
        predicted_bits.fits(x, SimpleNamespace(outputs=outputs, sample_steps=steps), masks, counted)  # loads
        noisy_values.fits(tuple(tables), None)

        def spawning(positions=positions, features=features, offsets=offsets, scales=scales) -> None:
            found = spawn.spawn(torch.zeros(3), positions, features, offsets, scales, None, networks)
            (found.means.sum() + found.opacities.sum()).backward()

        def values(rows=rows, tables=tables, noise=noise, sample=sample) -> None:
            noisy_values.noisy_values(rows, tuple(tables), None, 0.1, noise, sample).features.sum().backward()

        def of_steps(features=features, layers=layers) -> None:
            predicted_steps(features, tuple(layers), torch.ones(3), offset=1.0)[0].sum().backward()

        def bits(given=(x, mean, scale, steps, masks, counted)) -> None:
            sample_bits.bits_of(*given, 1e-6, 1e-9)[0].backward()

        def mixture(given=(x, outputs, steps, masks, counted, read)) -> None:
            predicted_bits.mixture_bits(*given)[0].backward()

        yield f"anchors: spawn of {count:,}", spawning
        yield f"anchors: noisy values of {count:,}", values
        yield f"anchors: predicted steps of {count:,}", of_steps
        yield f"anchors: bits of {len(sample):,}", bits
        yield f"hac: bits of {len(sample):,} from outputs", mixture


def measure(only: str) -> dict[str, float]:
    """Microseconds of each case, the minimum over half a second."""
    found = {}
    for name, run in cases():
        if only not in name:
            continue
        run()
        best, end = float("inf"), time.perf_counter() + 0.5
        while (began := time.perf_counter()) < end:
            run()
            best = min(best, time.perf_counter() - began)
        found[name] = 1e6 * best
    return found


def measure_in(checkout: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Measurements that another process makes with the sources of a checkout."""
    sources = [*checkout.glob("splatwizard-*/src"), *checkout.glob("plugins/*/src")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sources))}
    command = [sys.executable, __file__, "--measure", "--threads", str(arguments.threads), "--only", arguments.only]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="folder of another checkout")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        import torch

        torch.set_num_threads(arguments.threads)
        print(json.dumps(measure(arguments.only)))
        return
    best: list[dict[str, float]] = []
    checkouts = [HERE, *([arguments.against.resolve()] if arguments.against else [])]
    for _ in range(arguments.rounds):
        found = [measure_in(checkout, arguments) for checkout in checkouts]
        best = [{name: min(new[name], old.get(name, new[name])) for name in new}
                for new, old in zip(found, best or [{}] * len(found), strict=True)]  # fmt: skip
    for name, ours in best[0].items():
        theirs = best[1].get(name) if len(best) > 1 else None
        print(f"{name:50} {ours:10.1f} us" + ("" if theirs is None else f" {theirs:10.1f} us {theirs / ours:6.2f} x"))


if __name__ == "__main__":
    main()
