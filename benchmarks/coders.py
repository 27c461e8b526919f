"""Speed and size of the coders, entropy models and position codecs, each beside a yardstick taken in the same run.

    python benchmarks/coders.py [--symbols 1000000 10000000] [--repeats 5] [--only coders models positions]

Coders: millions of symbols per second beside the library `constriction` used plainly on the same arrays, and the ratio
ours / plain (1.00: our chunks, checks and checksums cost nothing). Float models are decoded again by the encoder, as a
proof: that time stands apart. Rates: bits per symbol beside the model's entropy and zstd level 19 on the same integers.
Processor seconds of one thread; the runs of both take turns, and the median of each counts.
"""

import argparse
import statistics
import time
import zlib

import constriction
import numpy as np
import torch
import zstandard

from splatwizard_core.plugins import load_plugins
from sw_codecs.bits import checksum

models = constriction.stream.model
queue, stack = constriction.stream.queue, constriction.stream.stack
huffman = constriction.symbol.huffman
ROWS = 1_000_000  # per-symbol tables that the library is handed at once: 128 MB
ZSTD_SAMPLE = 1_000_000  # symbols: level 19 takes a second for each


def in_turns(*functions, repeats):
    """Median of the seconds that each takes, one after another and again, and what each returned last."""
    seconds, results = [[] for _ in functions], [None] * len(functions)
    for _ in range(repeats):
        for i, function in enumerate(functions):
            results[i] = None  # freed here, not in the time of the next
            start = time.process_time()
            results[i] = function()
            seconds[i].append(time.process_time() - start)
    return [statistics.median(each) for each in seconds], results


def zstd_bits(symbols):
    sample = symbols[:ZSTD_SAMPLE]
    narrow = next(t for t in (np.int8, np.uint8, np.int16, np.int32) if np.array_equal(sample.astype(t), sample))
    return 8 * len(zstandard.ZstdCompressor(level=19).compress(sample.astype(narrow).tobytes())) / len(sample)


def families(n, specs):
    """Name, symbols int32 [n], our model, a plain model, its per-symbol parameters (or what makes those of a part),
    and the entropy in bits per symbol, if it is known.
    """
    r = np.random.default_rng(0)
    mean, scale = r.normal(0, 10, n), np.exp(r.uniform(np.log(0.2), np.log(20), n))
    for name, draw, ours, plain in (
        ("Gaussian, a mean and scale each", r.normal, specs.Gaussian, models.QuantizedGaussian),
        ("Laplace, a mean and scale each", r.laplace, specs.Laplace, models.QuantizedLaplace),
    ):
        k = np.rint(draw(mean, scale)).astype(np.int32)
        low, high = int(k.min()), int(k.max())
        yield name, k, ours(mean, scale, low, high), plain(low, high), (mean, scale), None
    k = np.rint(r.normal(0.3, 4, n)).astype(np.int32)
    low, high = int(k.min()), int(k.max())
    yield (
        "Gaussian, one",
        k,
        specs.Gaussian(0.3, 4.0, low, high),
        models.QuantizedGaussian(low, high, 0.3, 4.0),
        (),
        None,
    )
    counts = np.bincount(k - low)
    p = counts / n
    entropy = -(p[p > 0] * np.log2(p[p > 0])).sum()
    table = models.Categorical(counts.astype(float), perfect=False)
    yield f"table of {len(counts)}, one", k - np.int32(low), specs.Table(counts), table, (), entropy
    tables, index = r.integers(1, 50, (64, 16)), r.integers(0, 64, n)
    shares = (tables / tables.sum(1, keepdims=True)).cumsum(1)
    pieces = np.array_split(index, max(n // ROWS, 1))
    k = np.concatenate([(r.random(len(i))[:, None] > shares[i]).sum(1) for i in pieces]).clip(0, 15).astype(np.int32)

    def rows(start, stop):
        return (tables[index[start:stop]].astype(float),)

    yield "tables of 16, one of 64 each", k, specs.Tables(tables, index), models.Categorical(perfect=False), rows, None
    p = r.uniform(0.01, 0.99, n)
    yield "Bernoulli, a share each", (r.random(n) < p).astype(np.int32), specs.Bernoulli(p), models.Bernoulli(
        perfect=False), (p,), -(p * np.log2(p) + (1 - p) * np.log2(1 - p)).mean()  # fmt: skip
    yield "Bernoulli, one", (r.random(n) < 0.1).astype(np.int32), specs.Bernoulli(0.1), models.Bernoulli(
        0.1, perfect=False), (), 0.468996  # fmt: skip
    yield "1,000 alike", r.integers(0, 1000, n).astype(np.int32), specs.Uniform(1000), models.Uniform(1000), (), (
        np.log2(1000))  # fmt: skip


def plain_coder(name, symbols, model, parameters):
    """Encoder and decoder that do nothing but call the library."""
    n = len(symbols)
    if callable(parameters):
        parts = [(i, min(i + ROWS, n)) for i in range(0, n, ROWS)]
        make = parameters
    else:
        parts = [(0, n)]
        make = lambda start, stop: parameters  # noqa: E731

    def encode():
        coder = queue.RangeEncoder() if name == "range" else stack.AnsCoder()
        for start, stop in parts if name == "range" else reversed(parts):
            put = coder.encode if name == "range" else coder.encode_reverse
            put(symbols[start:stop], model, *make(start, stop))
        return coder.get_compressed()

    def decode(words):
        coder = queue.RangeDecoder(words) if name == "range" else stack.AnsCoder(words)
        found = []
        for start, stop in parts:
            given = make(start, stop)
            found.append(coder.decode(model, *given) if given else coder.decode(model, stop - start))
        return found

    return encode, decode


def plain_huffman(symbols, counts):
    numbers, p = symbols.tolist(), counts.astype(np.float32)

    def encode():
        coder, tree = constriction.symbol.QueueEncoder(), huffman.EncoderHuffmanTree(p)
        for symbol in numbers:
            coder.encode_symbol(symbol, tree)
        return coder.get_compressed_and_bitrate()[0]

    def decode(words):
        coder, tree = constriction.symbol.QueueDecoder(words), huffman.DecoderHuffmanTree(p)
        return np.array([coder.decode_symbol(tree) for _ in range(len(numbers))], np.int32)

    return encode, decode


def bench_coder(name, coder, family, symbols, ours, plain, repeats):
    """One line, and ours / plain of encoding and decoding. plain: (encode, decode) of the library alone."""
    n, fast = len(symbols), coder(verify=False)
    encode, decode = plain
    (ours_s, plain_s), (data, words) = in_turns(lambda: fast.encode(symbols, ours), encode, repeats=repeats)
    (ours_d, plain_d), (found, _) = in_turns(lambda: fast.decode(data, n, ours), lambda: decode(words), repeats=repeats)
    assert np.array_equal(found, symbols)
    proof = ""
    if family.startswith(("Gaussian", "Laplace")):
        (whole,), _ = in_turns(lambda: coder().encode(symbols, ours), repeats=2)
        proof = f"{max(whole - ours_s, 0) / ours_s:8.1f} x"
    print(
        f"{name:<8}{family:<33}{n / ours_s / 1e6:10.1f}{plain_s / ours_s:6.2f}"
        f"{n / ours_d / 1e6:16.1f}{plain_d / ours_d:6.2f}{proof:>10}"
        f"{8 * len(data) / n:11.4f}",
        end="",
    )
    return plain_s / ours_s, plain_d / ours_d


def bench_coders(plugins, n, repeats):
    print(f"\n{n:,} symbols: Msymbols/s, and ours / plain")
    print(f"{'':<41}{'encode':>16}{'decode':>22}{'proof':>10}{'bits/sym':>11}{'entropy':>9}{'zstd-19':>9}")
    coders = {name: plugins.coders.load(name) for name in ("range", "rans", "huffman")}
    ratios = {}
    for family, symbols, ours, model, parameters, entropy in families(n, coders["range"].specs):
        zstd = zstd_bits(symbols)
        for name, coder in coders.items():
            if name == "huffman":
                if not family.startswith("table of"):
                    continue
                plain = plain_huffman(symbols, ours.counts)
            else:
                plain = plain_coder(name, symbols, model, parameters)
            ratios[f"{name}, {family}"] = bench_coder(name, coder, family, symbols, ours, plain, repeats)
            print(f"{'' if entropy is None else f'{entropy:.4f}':>9}{zstd:9.3f}")
    for i, doing in enumerate(("encode", "decode")):
        worst = min(ratios, key=lambda case: ratios[case][i])
        print(f"lowest ours / plain, {doing}: {ratios[worst][i]:.2f} ({worst})")
    (ours_s, zlib_s), _ = in_turns(lambda: checksum.crc32(symbols), lambda: zlib.crc32(symbols), repeats=repeats)
    print(f"a CRC-32 of the symbols alone: {1e9 * ours_s / n:.2f} ns a symbol, by zlib {1e9 * zlib_s / n:.2f}")


def report(name, symbols, encode, decode, expected, yardstick_bytes, yardstick, repeats):
    (encode_s,), (data,) = in_turns(encode, repeats=repeats)
    (decode_s,), (found,) = in_turns(lambda: decode(data), repeats=repeats)
    assert np.array_equal(found, expected)
    print(
        f"{name:<34}{symbols / encode_s / 1e6:10.2f}{symbols / decode_s / 1e6:10.2f}{8 * len(data) / symbols:10.4f}"
        f"   {len(data) / yardstick_bytes:.4f} of {yardstick}"
    )


def bench_models(plugins, n, repeats):
    print(f"\nentropy models, {n:,} symbols\n{'':<34}{'enc MS/s':>10}{'dec MS/s':>10}{'bits/sym':>10}   size")
    r, load = np.random.default_rng(1), lambda name: plugins.entropy_models.load(name)
    mean, scale = r.normal(0, 20, n), np.exp(r.uniform(np.log(0.2), np.log(20), n))
    symbols = np.rint(r.normal(mean, scale)).astype(np.int64)
    exact = load("gaussian-exact")()
    context = exact.FloatContext(torch.from_numpy(mean), torch.from_numpy(scale))
    ideal = float(exact.bits(torch.from_numpy(symbols.astype(float)), context).sum()) / 8
    integers = exact.IntegerContext(np.rint(4096 * mean).astype(np.int64), np.rint(4096 * scale).astype(np.int64))
    report("gaussian-exact", n, lambda: exact.encode(symbols, integers), lambda d: exact.decode(d, integers), symbols,
           ideal, "its estimate", repeats)  # fmt: skip
    modes = np.rint(np.where(r.random(n) < 0.4, r.normal(-20, 2, n), r.normal(9, 5, n))).astype(np.int64)
    mixture = load("mixture")()
    two = mixture.Context(torch.tensor([0.4, 0.6]).log(), torch.tensor([-20.0, 9.0]), torch.tensor([2.0, 5.0]))
    ideal = float(mixture.bits(torch.from_numpy(modes).float(), two).double().sum()) / 8
    report("mixture", n, lambda: mixture.encode(modes, two), lambda d: mixture.decode(d, (n,)), modes, ideal,
           "its estimate", repeats)  # fmt: skip
    categorical, small = load("categorical")(), np.minimum(r.geometric(0.2, n) - 1, 63)
    for name, model, given, coded in (
        ("categorical", categorical, categorical.Context(64, n=n), small),
        ("bernoulli", load("bernoulli")(), n, small < 3),
    ):
        ideal = float(model.bits(torch.from_numpy(coded), given).double().sum()) / 8
        report(name, n, lambda m=model, g=given, c=coded: m.encode(c, g),
               lambda d, m=model, g=given: m.decode(d, g), coded, ideal, "its estimate", repeats)  # fmt: skip
    rows = max(n // 59, 1)
    scales = r.uniform(5, 40, 59)
    attributes = np.rint(r.normal(0, 1, (rows, 59)) * scales).clip(-128, 127).astype(np.int64)
    columns = load("columns")()
    zstd = len(zstandard.ZstdCompressor(level=19).compress(attributes.T.astype(np.int8).tobytes()))
    report("columns (59 x 8 bit)", attributes.size, lambda: columns.encode(attributes),
           lambda d: columns.decode(d, attributes.shape), attributes, zstd, "zstd-19", repeats)  # fmt: skip


def bench_positions(plugins, n, repeats):
    print(
        f"\npositions and plain numbers, {n:,} points\n{'':<34}{'enc MP/s':>10}{'dec MP/s':>10}{'bits/pt':>10}   size"
    )
    r, level_19 = np.random.default_rng(2), zstandard.ZstdCompressor(level=19)
    u = r.uniform(size=(n, 2)) * 2 * np.pi
    torus = np.stack(
        [(2 + np.cos(u[:, 1])) * np.cos(u[:, 0]), (2 + np.cos(u[:, 1])) * np.sin(u[:, 0]), np.sin(u[:, 1])], 1
    )
    points = ((torus + 3) / 6 * 65535).astype(np.int64)
    octree = plugins.coders.load("octree")()
    points = points[octree.sort(points)]
    yardstick = len(level_19.compress(points.T.astype(np.uint16).tobytes()))
    report("octree (torus, 16 bit)", n, lambda: octree.encode(points, 16), octree.decode, points, yardstick,
           "zstd-19, sorted", repeats)  # fmt: skip
    byte_planes, float_delta = (plugins.array_coders.load(name)() for name in ("byte-planes", "float-delta"))
    packed = plugins.array_coders.load("packed-bits")(8192)
    floats, halves = torus.astype(np.float32), (0.3 * r.normal(size=(n, 3))).astype(np.float16)
    ordered = floats[float_delta.sort(floats)]
    report("float-delta (f32, sorted)", n, lambda: float_delta.encode(ordered),
           lambda d: float_delta.decode(d, ordered.dtype, ordered.shape), ordered,
           ordered.nbytes, "the floats", 1)  # fmt: skip
    report("byte-planes (3 x f16)", n, lambda: byte_planes.encode(halves),
           lambda d: byte_planes.decode(d, halves.dtype, halves.shape), halves,
           len(level_19.compress(halves.tobytes())), "zstd-19", 1)  # fmt: skip
    indices = r.integers(0, 8192, n)
    report("packed-bits (13)", n, lambda: packed.encode(indices), lambda d: packed.decode(d, np.int64, (n,)), indices,
           13 * n / 8, "13 bits", repeats)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--symbols", type=int, nargs="+", default=[1_000_000, 10_000_000])
    parser.add_argument("--repeats", type=int, default=5)
    parts = {"coders": bench_coders, "models": bench_models, "positions": bench_positions}
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    plugins = load_plugins()
    for n in options.symbols if "coders" in options.only else []:
        bench_coders(plugins, n, options.repeats)
    for part in ("models", "positions"):
        if part in options.only:
            # Points are three numbers each, and their coders slower: half a million tell as much.
            parts[part](
                plugins, min(options.symbols[0], 500_000 if part == "positions" else 4_000_000), options.repeats
            )


if __name__ == "__main__":
    main()
