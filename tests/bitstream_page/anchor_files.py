"""Chapter 6: The files of each method, those of anchors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from bitstream_page.container import array
from bitstream_page.entropy_models import ExactTables, bernoulli, conditional, conditional_mixture
from bitstream_page.fields import Bytes, check
from bitstream_page.integer_networks import PAIRS, hash_grid, network, places, planes_under_models, triplane
from bitstream_page.positions import octree

Layers = list[tuple[np.ndarray, np.ndarray]]


def lattice(static: dict[str, Any], sections: dict[str, bytes]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest position [2,3]; the codes v [n,3]; which offsets there are [n,k]."""
    check(static["mode"] == "exact", "mode")
    bounds = np.frombuffer(sections["anchors"][:24], "<f4").astype(np.float64).reshape(2, 3)
    codes = octree(sections["anchors"][24:])
    return bounds, codes, masks_of(static, sections, len(codes))


def masks_of(static: dict[str, Any], sections: dict[str, bytes], anchors: int) -> np.ndarray:
    """Which offsets there are [n,k]."""
    n, k = static["num_anchors"], static["num_offsets"]
    masks = np.array(bernoulli(sections["masks"], n * k)).reshape(n, k) > 0
    check(anchors == n and masks.sum() == static["num_gaussians"], "number of anchors")
    return masks


def lattice_step(bounds: np.ndarray) -> np.ndarray:
    step = (bounds[1] - bounds[0]) / 65535
    return np.where(step > 0, step, 1e-6)


def positions_of(bounds: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Anchors [n,3] f32 with 16-bit codes."""
    return (codes * lattice_step(bounds) + bounds[0]).astype(np.float32)


class Weights:
    """The section `networks`: takes one network after the other."""

    def __init__(self, section: bytes, weights: str) -> None:
        self.file, self.form = Bytes(section), {"float32": "<f4", "float16": "<f2"}[weights]
        self.done = self.file.done

    def numbers(self, count: int) -> np.ndarray:
        return np.frombuffer(self.file.take(count * int(self.form[2])), self.form).astype(np.float32)

    def layers(self, *widths: int) -> Layers:
        found = []
        for a, b in itertools.pairwise(widths):
            numbers = self.numbers(a * b + b)
            found.append((numbers[: a * b].reshape(b, a), numbers[a * b :]))
        return found


def drawing_networks(static: dict[str, Any], weights: Weights) -> dict[str, Layers]:
    """Those that say how anchors are drawn: they come first, and nothing else in the file depends on them."""
    k, d, h = (static[name] for name in ("num_offsets", "feature_dim", "hidden"))
    return {
        "mlp_opacity": weights.layers(d + 4, h, k),
        "mlp_cov": weights.layers(d + 4, h, 7 * k),
        "mlp_color": weights.layers(d + 4, h, 3 * k),
    }


def units_of(steps: Sequence[float], groups: Sequence[int]) -> np.ndarray:
    """u of the outputs that predict: means and scales of each group, and the three t."""
    return np.array([1 / q for q, width in zip(steps, groups, strict=True) for _ in range(2 * width)] + [1.0] * 3)


def parameters(anchors: np.ndarray, values: Sequence[np.ndarray], drawing: dict[str, Layers]) -> dict[str, np.ndarray]:
    """The decoded model; `values` are features, scales and offsets."""
    return {
        "anchors": anchors,
        "features": values[0],
        "scales": values[1],
        "offsets": values[2].reshape(len(anchors), values[2].shape[1] // 3, 3),
        **{
            f"{name}.{2 * i}.{part}": numbers
            for name, found in drawing.items()
            for i, layer in enumerate(found)
            for part, numbers in zip(("weight", "bias"), layer, strict=True)
        },
    }


def hac(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    bounds, codes, masks = lattice(static, sections)
    drawing, values = under_grids(static, sections, tables, codes, masks)
    return parameters(positions_of(bounds, codes), values, drawing)


def hac_plus(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    data = sections["anchors"]
    bounds = np.frombuffer(data[:24], "<f4").astype(np.float64).reshape(2, 3)
    edge, lowest = np.frombuffer(data[24:32], "<f8")[0], np.frombuffer(data[32:44], "<i4")
    voxels = np.array(octree(data[44:]), np.int64).reshape(-1, 3) + lowest
    masks = masks_of(static, sections, len(voxels))
    positions = (voxels * edge).astype(np.float32)
    codes = np.floor((positions.astype(np.float64) - bounds[0]) / lattice_step(bounds))
    drawing, values = under_grids(static, sections, tables, np.clip(codes, 0, 65535).astype(np.int64), masks)
    return parameters(positions, values, drawing)


def under_grids(
    static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables, codes: np.ndarray, masks: np.ndarray
) -> tuple[dict[str, Layers], list[np.ndarray]]:
    """The networks that draw, and values of the groups, of anchors that hash grids predict."""
    n, k, d = (static[name] for name in ("num_anchors", "num_offsets", "feature_dim"))
    signs, levels, limits = static["grid_features"], (static["grid_space"], static["grid_planes"]), static["grid_log2"]
    grids = [(levels[len(axes) == 2], limits[len(axes) == 2], axes) for axes in ([0, 1, 2], [0, 1], [0, 2], [1, 2])]
    entries = sum(-(-min(1 << limit, r ** len(axes)) // 8) * 8 for shape, limit, axes in grids for r in shape)
    bits = iter(bernoulli(sections["grids"], signs * entries))
    seen = np.concatenate(
        [hash_grid(bits, shape, limit, signs, codes[:, axes]) for shape, limit, axes in grids], axis=1
    )

    weights = Weights(sections["networks"], static["weights"])
    drawing = drawing_networks(static, weights)
    groups = (d, 6, 3 * k)
    logits = d if static.get("channel", "none") != "none" else 0
    predicting = weights.layers(seen.shape[1], static["grid_hidden"], 2 * sum(groups) + 3 + logits)
    channels = Channels(static, weights) if logits else None
    weights.done()

    steps = static["base_steps"]
    units = np.concatenate([units_of(steps, groups), np.ones(logits)])
    outputs, at, values = network(predicting, units, seen), 0, []
    outputs, logit = outputs[:, : len(units) - logits], outputs[:, len(units) - logits :]
    for g, (name, width) in enumerate(zip(("features", "scalings", "offsets"), groups, strict=True)):
        numbers = np.clip((outputs[:, [g - 3]] + (1 << 15)) >> 9, 0, 127)
        m = np.array(tables.multipliers, np.int64)[numbers]
        there = np.repeat(masks, 3, axis=1) if name == "offsets" else np.ones((n, width), bool)
        mean, scale = outputs[:, at : at + width], outputs[:, at + width : at + 2 * width]
        if channels is not None and name == "features":
            i = channels.features(sections, tables, max(groups), (mean, scale, logit), m)
        else:
            i = conditional(sections[name], tables, max(groups), mean, scale, m, there)
        values.append((i * (m * (steps[g] / 4096))).astype(np.float32))
        at += 2 * width
    return drawing, values


class Channels:
    """The channel context of `hac-plus`."""

    def __init__(self, static: dict[str, Any], weights: Weights) -> None:
        self.slices, self.seen = static["slices"], 3 * sum(static["slices"]) * (static["channel"] == "full")
        self.free = None if self.seen else weights.numbers(3 * self.slices[0])
        starts = [sum(self.slices[:i]) for i in range(len(self.slices))]
        self.networks = [
            weights.layers(start + self.seen, static["channel_hidden"] if self.seen else 3 * size, 3 * size)
            if start + self.seen
            else None
            for start, size in zip(starts, self.slices, strict=True)
        ]

    def features(
        self,
        sections: dict[str, bytes],
        tables: ExactTables,
        c: int,
        first: tuple[np.ndarray, np.ndarray, np.ndarray],
        m: np.ndarray,
    ) -> np.ndarray:
        mean, scale, logit = first
        context = np.concatenate([*first], axis=1)[:, : self.seen]
        known = np.zeros((len(mean), 0), np.int64)
        for i, (size, layers) in enumerate(zip(self.slices, self.networks, strict=True)):
            part = slice(known.shape[1], known.shape[1] + size)
            if layers is None:
                assert self.free is not None
                out = np.tile(np.rint(self.free.astype(np.float64) * 4096).astype(np.int64), (len(mean), 1))
            else:
                inputs = np.concatenate([known * m, context], axis=1)
                out = network(layers, np.ones(3 * size), inputs, leaky=True)
            second_mean, second_scale, second_logit = np.split(out, 3, axis=1)
            parameters_ = (mean[:, part], second_mean, scale[:, part], second_scale, logit[:, part] - second_logit)
            coded = conditional_mixture(sections[f"features.{i + 1}"], tables, c, parameters_, m)
            known = np.concatenate([known, coded], axis=1)
        return known


def cat(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    n, k, d = (static[name] for name in ("num_anchors", "num_offsets", "feature_dim"))
    bounds, codes, masks = lattice(static, sections)
    weights = Weights(sections["networks"], static["weights"])
    drawing = drawing_networks(static, weights)
    groups, slices, s = (d, 6, 3 * k), static["slices"], static["slice_hidden"]
    outputs = 3 * static["channels"] * len(static["multiples"])
    predicting = weights.layers(outputs, static["context_hidden"], 2 * sum(groups) + 3)
    starts = [sum(slices[:i]) for i in range(len(slices))]
    refining = [weights.layers(start, s, 2 * size) for start, size in zip(starts[1:], slices[1:], strict=True)]
    more = [weights.layers(d, s, 2 * width) for width in groups[1:]] if static["refine"] else []
    spatial = [weights.layers(12, 16, 16, 16, 16, 2) for _ in PAIRS]
    for model in spatial:
        model[1:4] = [(w + np.eye(16, dtype=np.float32), b) for w, b in model[1:4]]
    weights.done()

    steps = static["base_steps"]
    check(steps[0] == 1, "step of features")
    values = [np.zeros((n, width), np.float32) for width in groups]
    if n:
        sizes = [m * static["resolution"] for m in static["multiples"]]
        shapes = [(3, static["channels"], size, size) for size in sizes]
        planes = planes_under_models(sections["triplane"], tables, shapes, spatial)
        frame = array(sections["frame"]).astype(np.float64)
        units = units_of(steps, groups)
        seen = triplane(planes, places(frame, bounds, codes))
        out, at = network(predicting, units, seen), 0
        numbers = np.clip((out[:, -3:] + (1 << 15)) >> 9, 0, 127)
        m = np.array(tables.multipliers, np.int64)[numbers] + 410
        known = np.zeros((n, 0), np.int64)
        for g, width in enumerate(groups):
            mean, scale = out[:, at : at + width].copy(), out[:, at + width : at + 2 * width].copy()
            at += 2 * width
            if g == 0:
                for i, (start, size) in enumerate(zip(starts, slices, strict=True)):
                    part = slice(start, start + size)
                    if i > 0:
                        shift = network(refining[i - 1], np.ones(2 * size), known * m[:, [0]])
                        mean[:, part] += shift[:, :size]
                        scale[:, part] += shift[:, size:]
                    there = np.ones((n, size), bool)
                    section, parameters_ = sections[f"features.{i + 1}"], (mean[:, part], scale[:, part], m[:, [0]])
                    coded = conditional(section, tables, max(groups), *parameters_, there)
                    known = np.concatenate([known, coded], axis=1)
                integers = known
            else:
                if more:
                    shift = network(more[g - 1], np.full(2 * width, 1 / steps[g]), known * m[:, [0]])
                    mean, scale = mean + shift[:, :width], scale + shift[:, width:]
                there = np.repeat(masks, 3, axis=1) if g == 2 else np.ones((n, width), bool)
                name = ("scalings", "offsets")[g - 1]
                integers = conditional(sections[name], tables, max(groups), mean, scale, m[:, [g]], there)
            values[g] = (integers * (m[:, [g]] * (steps[g] / 4096))).astype(np.float32)
    return parameters(positions_of(bounds, codes), values, drawing)
