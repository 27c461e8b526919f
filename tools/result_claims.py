"""Claims of papers whose data sets are not at hand, beside what small scenes of the same kind give: `table claims all`.

Ratio and difference are to the exact 3DGS of the same seed and matrix of runs: its float32 .ply (248 bytes
per Gaussian) over the file, and PSNR less its PSNR. Runs whose matrix has no such record are left out; where none
has one, all are compared with the mean of every exact 3DGS of the scene, and the cell is marked.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from result_groups import NONE, PLY_BYTES, Rows, bases, exact, points, rate, smaller, spread, title
from result_records import RECORDS, read


@dataclass(frozen=True)
class Claim:
    """Claim of a paper for a method on one data set: so many times smaller for so much PSNR, dB."""

    data: str
    ratio: float
    loss: float
    scenes: tuple[str, ...]  # of the same kind: photographs of a place, or renderings of an object


ELSEWHERE = " †"  # beside the mean over all 3DGS of the scene
PHOTOGRAPHS, RENDERINGS = ("fox", "room"), ("lego",)
CLAIMS: dict[tuple[str, str], tuple[Claim, ...]] = {
    # C3DGS (arXiv 2401.02436), MesonGS (arXiv 2409.09756), Compact3DGS (arXiv 2311.13681; r7 is without +PP).
    ("c3dgs", ""): (
        Claim("Mip-NeRF 360", 26, -0.23, PHOTOGRAPHS),
        Claim("NeRF-Synthetic", 19, -0.37, RENDERINGS),
    ),
    ("mesongs", ""): (Claim("NeRF-Synthetic", 27.5, -0.36, RENDERINGS),),
    ("compact3dgs", "r7"): (Claim("Mip-NeRF 360", 15, -0.1, PHOTOGRAPHS),),
    ("compact3dgs", "r5"): (Claim("Mip-NeRF 360, with +PP", 25, -0.1, PHOTOGRAPHS),),
}


def table(records_at: Path = RECORDS) -> str:
    """Write the table over the scenes of the claims' kinds that have a record of one of the methods."""
    methods = {method for method, _ in CLAIMS}
    kinds = {scene for claims in CLAIMS.values() for claim in claims for scene in claim.scenes}
    scenes = {path.stem: read(path) for path in sorted(records_at.glob("*.jsonl")) if path.stem in kinds}
    scenes = {scene: found for scene, found in scenes.items() if methods & {r.method for r in found}}
    if not scenes:
        return "*No records of them yet.*\n"
    found: dict[tuple[str, str, str], dict[str, Rows]] = {}
    for scene, records in scenes.items():
        for group in points([r for r in records if r.method in methods]):
            found.setdefault((group[0].method, group[0].variant, group[0].rate), {})[scene] = group
    rows = [["method", "rate", "claim", *(f"{scene} {records[0].images}" for scene, records in scenes.items())]]
    for (method, _, point), of_scenes in sorted(found.items()):
        first = next(iter(of_scenes.values()))
        claims = CLAIMS.get((method, point)) or CLAIMS.get((method, "")) or ()
        cells = [_cell(of_scenes.get(scene), records, scene, claims) for scene, records in scenes.items()]
        told = "; ".join(f"{c.ratio:g}x, {c.loss:+.2f} dB ({c.data})" for c in claims)
        rows.append([title(first), rate(first), told or NONE, *cells])
    head, *left = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([head, "|---" * len(rows[0]) + "|", *left, ""])


def _cell(group: Rows | None, records: Rows, scene: str, claims: Iterable[Claim]) -> str:
    """Write ratio, difference and number of runs; bold where a claim on data of this kind is reached by both."""
    if group is None:
        return NONE
    pairs = zip(group, bases(group, records, same_matrix=True), smaller(group, records, same_matrix=True), strict=True)
    known = [
        (ratio, r.psnr - base.psnr)
        for r, base, ratio in pairs
        if r.psnr is not None and base is not None and base.psnr is not None and ratio is not None
    ]
    mark = "" if known else ELSEWHERE
    known = known or _beside_all(group, exact(records))
    if not known:
        return NONE
    ratio, loss = (sum(values) / len(known) for values in zip(*known, strict=True))
    reached = any(scene in c.scenes and ratio >= c.ratio and round(loss, 2) >= c.loss for c in claims)
    sign = "+" if loss >= 0 else ""
    ratios, losses = (list(values) for values in zip(*known, strict=True))
    text = f"{spread(ratios, 1)}x, {sign}{spread(losses, 2)} dB{mark}"
    text += f" (n = {len(known)})" if len(known) > 1 else ""
    return f"**{text}**" if reached else text


def _beside_all(group: Rows, plain: Rows) -> list[tuple[float, float]]:
    """Ratio and difference of each run to the means over all exact 3DGS of the scene."""
    sizes = [PLY_BYTES * r.gaussians for r in plain if r.gaussians]
    found = [r.psnr for r in plain if r.psnr is not None]
    if not sizes or not found:
        return []
    size, psnr = statistics.fmean(sizes), statistics.fmean(found)
    return [(size / r.bytes, r.psnr - psnr) for r in group if r.psnr is not None]
