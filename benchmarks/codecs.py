"""Speed and size of the codecs in sw-codecs, each beside a yardstick measured in the same run.

    python benchmarks/codecs.py [--gaussians 250000] [--repeats 3]

Sizes are ratios to the entropy of the model or to zstd level 19 on the same integers; one thread, median of repeats.
"""

import argparse
import statistics
import time

import numpy as np
import torch
import zstandard

from splatwizard_core.plugins import load_plugins
from sw_codecs import morton
from sw_codecs.gaussian_exact import FloatContext, IntegerContext
from sw_codecs.integer_mlp import to_fixed
from sw_codecs.model_spec import Gaussian


def timed(function, repeats):
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def report(name, symbols, encode, decode, expected, yardstick_bytes, yardstick, repeats):
    data, encode_s = timed(encode, repeats)
    found, decode_s = timed(lambda: decode(data), repeats)
    assert np.array_equal(found, expected)
    print(
        f"{name:<28} {symbols / encode_s / 1e6:8.1f} {symbols / decode_s / 1e6:8.1f} {8 * len(data) / symbols:9.4f}"
        f"   {len(data) / yardstick_bytes:.4f} of {yardstick}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=250_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    n, repeats, plugins, r = options.gaussians, options.repeats, load_plugins(), np.random.default_rng(0)

    def zstd(array):
        return len(zstandard.ZstdCompressor(level=19).compress(np.ascontiguousarray(array).tobytes()))

    print(f"{'codec':<28} {'enc MS/s':>8} {'dec MS/s':>8} {'bits/sym':>9}   size")

    attributes = (
        np.stack([np.rint(r.normal(0, s, n)) for s in r.uniform(5, 40, 59)], 1).clip(-128, 127).astype(np.int64)
    )
    columns = plugins.entropy_models.load("columns")()
    report("columns (59 x 8 bit)", attributes.size, lambda: columns.encode(attributes),
           lambda d: columns.decode(d, attributes.shape), attributes, zstd(attributes.T.astype(np.int8)),
           "zstd-19", repeats)  # fmt: skip

    u = r.uniform(size=(n, 2)) * 2 * np.pi
    torus = np.stack(
        [(2 + np.cos(u[:, 1])) * np.cos(u[:, 0]), (2 + np.cos(u[:, 1])) * np.sin(u[:, 0]), np.sin(u[:, 1])], 1
    )
    points = ((torus + 3) / 6 * 65535).astype(np.int64)
    points = points[morton.sort(points)]
    for name in ("octree", "morton-delta"):
        codec = plugins.coders.load(name)()
        report(f"{name} (torus, 16 bit)", n, lambda codec=codec: codec.encode(points, 16), codec.decode, points,
               zstd(points.T.astype(np.uint16)), "zstd-19, sorted", repeats)  # fmt: skip

    mean, scale = r.normal(0, 20, 4 * n), np.exp(r.uniform(np.log(0.2), np.log(20), 4 * n))
    symbols = np.rint(r.normal(mean, scale)).astype(np.int64)
    exact = plugins.entropy_models.load("gaussian-exact")()
    floats = FloatContext(torch.from_numpy(mean), torch.from_numpy(scale))
    ideal = float(exact.bits(torch.from_numpy(symbols.astype(float)), floats).sum()) / 8
    context = IntegerContext(to_fixed(mean), to_fixed(scale))
    report("gaussian-exact", 4 * n, lambda: exact.encode(symbols, context), lambda d: exact.decode(d, context), symbols,
           ideal, "the entropy", repeats)  # fmt: skip
    spec = Gaussian(mean, scale, int(symbols.min()), int(symbols.max()))
    for name in ("range", "rans"):
        coder = plugins.coders.load(name)()
        report(f"{name}, float Gaussian", 4 * n, lambda coder=coder: coder.encode(symbols, spec),
               lambda d, coder=coder: coder.decode(d, 4 * n, spec), symbols, ideal, "the entropy", repeats)  # fmt: skip


if __name__ == "__main__":
    main()
