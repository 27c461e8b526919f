"""Codebooks of `vq` beside scikit-learn's MiniBatchKMeans: seconds, memory, error after equal passes over equal rows.

    python benchmarks/vector_quantization.py [--rows 1000000] [--codes 8192] [--passes 5] [--device cpu] [--data sh]
    python benchmarks/vector_quantization.py --rows 50000 --codes 512          # seconds instead of minutes
    python benchmarks/vector_quantization.py --only fit --only train           # without scikit-learn
    python benchmarks/vector_quantization.py --only sklearn                    # scikit-learn alone, on another machine

Each contestant runs in a process of its own, so that its peak memory is its own; all use the threads that
OMP_NUM_THREADS allows. A pass is one look at as many rows as there are: N * K distances. What each does before its
first pass (k-means++ on 3 K rows there, spread seeds and four iterations on 16 K rows here) is in the seconds, not in
the passes. The error is that of an exact search in the codebook, the same search for all. Without scikit-learn its row
is left out (`pip install scikit-learn`).

data     sh        rows like SH coefficients: 64 loose clusters, heavy tails, less spread in higher degrees
         clusters  as many tight clusters as codes: who finds them all?
         normal    no structure at all
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.base.memory import peak_rss_bytes
from splatwizard_core.plugins import load_plugins

CONTESTANTS = {"fit": "vq.fit", "train": "vq.train, ema", "sklearn": "MiniBatchKMeans"}


def rows_of(options):
    g = torch.Generator().manual_seed(options.seed)
    n, d = options.rows, options.width
    if options.data == "normal":
        return torch.randn(n, d, generator=g)
    if options.data == "clusters":
        centres = 3 * torch.randn(options.codes, d, generator=g)
        return torch.randn(n, d, generator=g).mul_(0.3).add_(centres[torch.randint(options.codes, (n,), generator=g)])
    degree = torch.sqrt(torch.arange(d) // 3).floor()  # of each coefficient, three colours each
    spread = torch.tensor([1.0, 0.3, 0.15, 0.08])[degree.clamp(max=3).long()]
    tails = torch.exp(0.7 * torch.randn(n, 1, generator=g))
    x = torch.randn(n, 12, generator=g).mul_(tails) @ (0.5 * torch.randn(12, d, generator=g))
    x += torch.randn(64, d, generator=g)[torch.randint(64, (n,), generator=g)]
    x += torch.randn(n, d, generator=g).mul_(0.5 * tails.sqrt())
    return x * spread


def contest(options):
    """Run in a child: train, save the codebook, print seconds and peak memory."""
    x = rows_of(options).to(options.device)
    if options.contestant == "sklearn":
        from sklearn.cluster import MiniBatchKMeans

        # Without early stopping and without the labels that nobody asks for.
        model = MiniBatchKMeans(
            options.codes, batch_size=options.sklearn_batch or 2 * options.codes, max_iter=options.passes,
            max_no_improvement=None, n_init=1, compute_labels=False, random_state=options.seed,
        )  # fmt: skip
        rows = x.cpu().numpy()
        start = time.perf_counter()
        codebook = model.fit(rows).cluster_centers_
        seconds = time.perf_counter() - start
    else:
        vq = load_plugins().quantizers.load("vq")(options.codes)
        g = torch.Generator(options.device).manual_seed(options.seed)
        start = time.perf_counter()
        if options.contestant == "fit":
            vq.fit(x, generator=g, iterations=options.passes)
        else:
            batch = min(80_000, options.rows)
            vq.train(x, None, max(1, round(options.passes * options.rows / batch)), batch, generator=g)
        codebook = vq.codebook.cpu().numpy()
        seconds = time.perf_counter() - start
    np.save(options.save, codebook)
    gpu = torch.cuda.max_memory_allocated() if options.device.startswith("cuda") else 0
    # Not getrusage: a child's figure there begins with what its parent held.
    print(json.dumps({"seconds": seconds, "memory": peak_rss_bytes(), "gpu": gpu}))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--codes", type=int, default=8192)
    parser.add_argument("--width", type=int, default=48)
    parser.add_argument("--passes", type=int, default=5)
    parser.add_argument("--device", default="cpu", help="of vq; scikit-learn has the CPU only")
    parser.add_argument("--data", choices=["sh", "clusters", "normal"], default="sh")
    parser.add_argument("--only", choices=list(CONTESTANTS), action="append", help="may be given more than once")
    parser.add_argument("--sklearn-batch", type=int, default=0, help="rows; 0: twice the codes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--contestant", choices=list(CONTESTANTS), help=argparse.SUPPRESS)
    parser.add_argument("--save", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.contestant:
        contest(options)
        return
    wanted = [c for c in CONTESTANTS if not options.only or c in options.only]
    if "sklearn" in wanted and importlib.util.find_spec("sklearn") is None:
        print("scikit-learn is not installed: no row for it (pip install scikit-learn)", file=sys.stderr)
        wanted.remove("sklearn")
    threads = os.environ.get("OMP_NUM_THREADS", f"{torch.get_num_threads()}, by torch")
    print(
        f"{options.rows:,} x {options.width} {options.data}, {options.codes:,} codes, {options.passes} passes, "
        f"vq on {options.device}, threads {threads}"
    )
    vq = load_plugins().quantizers.load("vq")(options.codes)
    x = rows_of(options).to(options.device)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            save = str(Path(folder) / f"{name}.npy")
            command = [sys.executable, __file__, *sys.argv[1:], "--contestant", name, "--save", save]
            child = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found[name] = json.loads(child.stdout.splitlines()[-1])
            vq.codebook = torch.from_numpy(np.load(save)).to(x)
            decoded = vq.forward(x)
            blocks = zip(x.split(4096), decoded.split(4096), strict=True)
            found[name]["mse"] = sum(float((a - b).double().square().sum()) for a, b in blocks) / x.numel()
    reference = found.get("sklearn")
    ratios = f" {'seconds':>9} {'MSE':>8}   ratio to scikit-learn" if reference else ""
    print(f"{'':<18} {'seconds':>9} {'peak GB':>8} {'GPU GB':>7} {'MSE':>11}{ratios}")
    for name, row in found.items():
        line = f"{CONTESTANTS[name]:<18} {row['seconds']:9.1f} {row['memory'] / 1e9:8.2f} {row['gpu'] / 1e9:7.2f}"
        line += f" {row['mse']:11.6f}"
        if reference:
            line += f" {row['seconds'] / reference['seconds']:9.3f} {row['mse'] / reference['mse']:8.4f}"
        print(line)


if __name__ == "__main__":
    main()
