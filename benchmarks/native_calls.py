"""Time of calls of native operations from Python, small and large, beside those of another checkout.

    python benchmarks/native_calls.py [--against CHECKOUT] [--rounds 5] [--threads 1] [--only adam]

Each checkout runs in a process of its own on its own sources; they take turns, so that a busy machine slows both alike.
Microseconds are the minimum over all rounds; "x" is the time of the other checkout over ours (above 1: ours is faster).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and call of each case; what checkouts share is used alone."""
    import torch

    from splatwizard_native import AdamUpdate, adam_steps, photometric

    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    for count in (1, 100, 10_000, 200_000):  # Gaussians, of six tensors with 59 numbers
        shapes = [(count, columns) for columns in (3, 3, 45, 1, 3, 4)]
        updates = [AdamUpdate(*(rand(*s) for _ in range(4)), 1e-3, 0.9, 0.999, 1e-15, 10) for s in shapes]
        yield f"adam of {count:,} Gaussians", lambda updates=updates: adam_steps(updates)
    for height, width in ((16, 16), (135, 240), (540, 960)):
        image, target = rand(3, height, width).requires_grad_(), rand(3, height, width)

        def loss(image: torch.Tensor = image, target: torch.Tensor = target) -> None:
            image.grad = None
            photometric(image, target, 0.2)[0].backward()

        yield f"photometric {width} x {height}, forward and backward", loss


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
