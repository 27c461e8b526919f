"""Tables of numbers: runs of one scene, means over data sets, BD values, settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sw_report import numbers
from sw_report.aggregate import DatasetTable, MeanRow
from sw_report.bases import STEPS_NOTE, bases_notes
from sw_report.blocks import Cell, Column, Note, Row, Table, columns, row
from sw_report.declared import metric_style
from sw_report.distortion import BdCell, BdTable
from sw_report.facts import RunFacts, clean, shown
from sw_report.marks import marked
from sw_report.runs import Run, machine


def metric_names(runs: Iterable[Run], *, diagnostic: bool = False) -> list[str]:
    """Names of the metrics that some run has values of; diagnostic ones, which tell conventions apart, if asked for."""
    return numbers.ordered_metrics(
        name
        for run in runs
        for name, metric in run.facts.metrics.items()
        if (diagnostic or not run.facts.is_diagnostic(name)) and (metric.mean is not None or metric.per_view)
    )


def missing_metrics(runs: Iterable[Run]) -> list[str]:
    """One line for each reason why metrics have no value."""
    reasons: dict[str, dict[str, str]] = {}
    for run in runs:
        for name in numbers.ordered_metrics(run.facts.metrics):
            if run.mean(name) is None and not run.facts.is_diagnostic(name):
                why = run.facts.unknown.get(f"metrics.{name}.mean", "the record gives no reason")
                reasons.setdefault(why, {})[name] = numbers.heading(name)
    return [Note(f"{', '.join(names.values())}: {why}", *names) for why, names in reasons.items()]


def runs_table(runs: Sequence[Run], *, diagnostic: bool = False) -> Table:
    """One row a configuration and rate point: quality, size, times; of several seeds, mean ± standard deviation.

    diagnostic  with the metrics that tell conventions apart
    """
    names = metric_names(runs, diagnostic=diagnostic)
    several = any(len(run.seeds) > 1 for run in runs)
    heads = [
        Column("method", text=True, key="method"), Column("rate", text=True, key="rate"),
        *([Column("seeds", key="seeds")] if several else []),
        *(Column(numbers.heading(name), key=name, better=_direction(runs, name)) for name in names),
        Column("MB", key="size", better="lower"), Column("primitives", key="primitives"), Column("steps", key="steps"),
        *(Column(head, key=key, better="higher" if key == "fps" else "lower") for (head, *_), key in
          zip(MEASURED, MEASURED_KEYS, strict=True)),
    ]  # fmt: skip
    marks = machine_marks(runs)
    rows: list[Row] = []
    for run in runs:
        facts = run.facts
        cells: list[str | Cell] = [run.variant, facts.rate_label() or numbers.MISSING]
        cells += [str(len(run.seeds))] if several else []
        cells += [_scored(run, name) for name in names]
        cells += [
            Cell(numbers.megabytes(run.size), f"{run.size:,.0f} bytes"),
            numbers.counts({unit: round(n) for unit, n in run.counts.items()}),
            facts.all_steps(),
            *(_measured(run, column, marks) for column in MEASURED),
        ]
        rows.append(row(cells))
    if len({run.variant for run in runs}) > 1:
        first = 2 + several
        compared = {first + i: ([run.mean(n) for run in runs], _direction(runs, n)) for i, n in enumerate(names)}
        compared[first + len(names)] = ([run.size for run in runs], "lower")
        if not marks and not any(run.contended("render") for run in runs):
            compared[len(heads) - 1] = ([run.over_seeds(lambda facts: facts.speed.fps)[0] for run in runs], "higher")
        rows = marked(rows, compared)
    views = {run.facts.test_views or len(run.facts.views) for run in runs}
    caption = f"Means over {', '.join(map(str, sorted(views)))} test views."
    notes = missing_metrics(runs)
    if any("fit" in run.facts.flags for run in runs):
        notes.append("The test views are training views too: scores are quality of fit, not of novel views.")
    notes += uncompressed_notes(run.facts for run in runs)
    if any(run.facts.train.pretraining for run in runs):
        notes.append(Note(STEPS_NOTE, "steps"))
        notes += bases_notes((run.facts for run in runs), {id(run.facts): run.variant for run in runs})
    if several:
        notes.append(numbers.SEEDS_NOTE)
    if any(facts.contended for run in runs for facts in run.seeds):
        notes.append(Note(numbers.SHARED_NOTE, *MEASURED_KEYS))
    if marks:
        told = "; ".join(f"{mark} {name}" for name, mark in marks.items())
        text = f"Times and FPS come from different machines, and are not comparable: {told}."
        notes.append(Note(text, *MEASURED_KEYS))
    if bound := sorted({run.facts.method for run in runs if "device-bound" in run.facts.flags}):
        notes.append(f"Device-bound: files of {', '.join(bound)} decode only on the machine that made them.")
    return Table("Results", heads, rows, caption, notes, sortable=True)


def uncompressed_notes(runs: Iterable[RunFacts]) -> list[str]:
    """One line for each number format of files that are not compressed."""
    names = dict.fromkeys(run.uncompressed() for run in runs)
    return [Note(numbers.UNCOMPRESSED_NOTE.format(name), "rate") for name in names if name]


MEASURED: tuple[tuple[str, str, Callable[[RunFacts], float | None], Callable[[float | None], str]], ...] = (
    ("train s", "train", lambda facts: facts.train.with_pretraining_s, numbers.seconds),
    ("encode s", "encode", lambda facts: facts.codec.encode_s, numbers.seconds),
    ("decode s", "decode", lambda facts: facts.codec.decode_s, numbers.seconds),
    ("FPS", "render", lambda facts: facts.speed.fps, numbers.rate),
)
"""Values that depend on the machine: head of the column, phase, value, spelling. Training includes the base scene's."""


MEASURED_KEYS = ("train", "encode", "decode", "fps")


def _direction(runs: Sequence[Run], metric: str) -> str:
    return next((run.facts.metrics[metric].direction for run in runs if metric in run.facts.metrics), "higher")


def machine_marks(runs: Sequence[Run]) -> dict[str, str]:
    """Mark of each machine that the runs were measured on; none if it is one."""
    machines = list(dict.fromkeys(machine(facts) for run in runs for facts in run.seeds))
    last = len(numbers.MACHINES) - 1
    return {name: numbers.MACHINES[min(i, last)] for i, name in enumerate(machines)} if len(machines) > 1 else {}


def _scored(run: Run, name: str) -> Cell:
    value, deviation = run.mean(name), run.deviation(name)
    why = run.facts.unknown.get(f"metrics.{name}.mean", "") if value is None else f"{value:.6f}"
    text = numbers.score(name, value)
    return Cell(numbers.with_deviation(text, None if deviation is None else numbers.score(name, deviation)), why)


def _measured(
    run: Run,
    column: tuple[str, str, Callable[[RunFacts], float | None], Callable[[float | None], str]],
    marks: dict[str, str],
) -> Cell:
    """A time or a rate, marked where other processes had a part in it, and with its machine if there are several."""
    _, phase, value, spelt = column
    found, deviation = run.over_seeds(value)
    text = numbers.with_deviation(spelt(found), None if deviation is None else spelt(deviation))
    own = "".join(sorted({marks[name] for facts in run.seeds if (name := machine(facts)) in marks}))
    title = "with the training of scenes that it starts from" if phase == "train" else ""
    return Cell(numbers.shared(text, found is not None and run.contended(phase)) + (own if found is not None else ""),
                title)  # fmt: skip


def means_table(table: DatasetTable) -> Table:
    """Plain means over the scenes of a data set."""
    names = list(dict.fromkeys(name for r in table.rows for name in r.metrics))
    several = any(r.seeds > 1 for r in table.rows)
    heads = [
        Column("method", text=True, key="method"), Column("rate", text=True, key="rate"),
        Column("scenes", key="scenes"),
        *([Column("seeds", key="seeds")] if several else []),
        *(Column(numbers.heading(name), key=name, better=table.directions[name]) for name in names),
        Column("MB", key="size", better="lower"), Column("primitives", key="primitives"),
    ]  # fmt: skip
    rows = []
    for r in table.rows:
        of = f"{len(r.scenes)} of {len(table.scenes)}"
        where = f"missing: {', '.join(r.missing)}" if r.missing else "all scenes"
        rows.append(
            row(
                [
                    r.variant, r.rate or numbers.MISSING, Cell(of, where),
                    *([str(r.seeds)] if several else []), *(_mean_score(r, name) for name in names),
                    numbers.megabytes(r.size), numbers.counts({k: round(v) for k, v in (r.counts or {}).items()}),
                ]
            )
        )  # fmt: skip
    if len({r.variant for r in table.rows}) > 1:
        first = 3 + several
        compared = {first + i: ([r.metrics[n] for r in table.rows], table.directions[n]) for i, n in enumerate(names)}
        compared[first + len(names)] = ([r.size for r in table.rows], "lower")
        rows = marked(rows, compared)
    return Table(
        f"Means over {table.title}", heads, rows,
        f"Plain means over {', '.join(table.scenes)}.", means_notes(table), sortable=True,
    )  # fmt: skip


def _mean_score(found: MeanRow, name: str) -> str:
    deviation = found.deviations.get(name)
    told = None if deviation is None else numbers.score(name, deviation)
    return numbers.with_deviation(numbers.score(name, found.metrics[name]), told)


def means_notes(table: DatasetTable) -> list[str]:
    """Lines under the means: which scenes are missing, and which protocols differ."""
    lacking: dict[tuple[str, tuple[str, ...], bool], list[str]] = {}
    for r in table.rows:
        if r.missing:
            lacking.setdefault((r.variant, r.missing, r.size is None), []).append(r.rate or "")
    notes = []
    for (variant, missing, unknown), rates in lacking.items():
        kind = "no mean" if unknown else "mean of what is there"
        name = f"{variant} {', '.join(filter(None, rates))}".strip()
        notes.append(f"{name}: {kind}, {_some(missing)} missing.")
    if any(r.seeds > 1 for r in table.rows):
        notes.append(f"{numbers.SEEDS_NOTE} Each seed's value is its mean over the scenes.")
    if len(table.protocols) > 1:
        notes.append(f"The scenes use different picture folders: {'; '.join(table.protocols)}.")
    return notes


def _some(names: Sequence[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def bd_table(table: BdTable) -> Table:
    """BD-rate and BD-quality of every method against the anchor."""
    style = metric_style(table.metric)
    rows = []
    for r in table.rows:
        rows.append(
            row(
                [r.variant, r.scene or "mean", _bd(r.rate, numbers.percent(r.rate.value)),
                 _bd(r.quality, numbers.signed(r.quality.value, style.digits))],
                emphasis=r.scene is None,
            )
        )  # fmt: skip
    heads = ["method", "scene", f"BD-rate ({style.label}) %", f"BD gain, {style.unit or style.label}"]
    marks = dict.fromkeys(
        f"* {c.reason}" if c.value is not None else f"{numbers.MISSING} {r.variant}, {r.scene or 'mean'}: {c.reason}"
        for r in table.rows for c in (r.rate, r.quality) if c.reason
    )  # fmt: skip
    return Table(
        f"Against {table.anchor} by {style.heading}", columns(heads, text=("method", "scene")), rows,
        f"{table.chosen} Rate at equal quality (negative saves), quality at equal rate (positive is better"
        f"{': lower values' if table.lower else ''}).",
        list(marks),
    )  # fmt: skip


def _bd(cell: BdCell, text: str) -> Cell:
    return Cell(text + (" *" if cell.value is not None and cell.reason else ""), cell.reason)


def protocol_table(runs: Sequence[Run]) -> Table:
    """Rules of each protocol, one column a protocol; rows in which they differ are marked."""
    protocols = {run.facts.protocol.id: run.facts.rules() for run in runs}
    names = list(dict.fromkeys(name for rules in protocols.values() for name in rules))
    several = len(protocols) > 1
    heads = ["rule", *protocols] + ["" for _ in range(several)]
    rows = []
    for name in names:
        values = [plain(rules.get(name)) for rules in protocols.values()]
        differ = len(set(values)) > 1
        rows.append(
            row([name.replace("_", " "), *values, *(["differs" if differ else ""] if several else [])], emphasis=differ)
        )
    return Table("Protocol", columns(heads, text=heads, long=list(protocols)), rows)


def plain(value: Any) -> str:
    """A value of a record as text."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return clean(", ".join(f"{k} {plain(v)}" for k, v in value.items()))
    if isinstance(value, (list, tuple)):
        return clean(", ".join(plain(v) for v in value) or "none")
    return clean(str(value))


def environment_table(runs: Sequence[Run]) -> Table:
    """Environments of the runs, one column for each different one."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(plain(dict(sorted(run.facts.environment.items(), key=lambda i: str(i[0])))), []).append(run)
    chosen = [group[0].facts for group in groups.values()]
    heads = ["", *(_who(group, len(runs)) for group in groups.values())]
    names = list(dict.fromkeys(name for facts in chosen for name in facts.environment))
    rows = [row(["machine", *map(machine, chosen)])]
    for name in names:
        if name == "packages":
            packages = [facts.environment.get(name) for facts in chosen]
            known = [p if isinstance(p, dict) else {} for p in packages]
            for package in dict.fromkeys(str(key) for p in known for key in p):
                rows.append(row([clean(package), *(plain(p.get(package)) for p in known)]))
        else:
            rows.append(row([name.replace("_", " "), *(plain(facts.environment.get(name)) for facts in chosen)]))
    return Table("Environment", columns(heads, text=heads, long=heads[1:]), rows)


def _who(group: Sequence[Run], total: int) -> str:
    if len(group) == total:
        return "all runs" if total > 1 else "this run"
    return ", ".join(f"{run.facts.scene} {run.label}" for run in group[:3]) + (
        f" and {len(group) - 3} more" if len(group) > 3 else ""
    )


def served_table(runs: Sequence[Run]) -> Table:
    """Rasterizers that served the phases, and the distribution of each method."""
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        facts = run.facts
        phases = ["; ".join(f"{name} ({asked})" for asked, name in facts.rasterizers.get(phase, {}).items())
                  for phase in ("train", "render")]  # fmt: skip
        version = f", layout {facts.method_version}" if facts.method_version is not None else ""
        source = f"{facts.distribution or 'unknown'}{version}"
        groups.setdefault((run.variant, source, *(p or numbers.MISSING for p in phases)), []).append(run)
    rows = []
    for (variant, source, train, render), group in groups.items():
        rows.append(row([variant, _who(group, len(runs)), source, train, render]))
    heads = ["method", "runs", "distribution", "training drawn by", "evaluation drawn by"]
    return Table("Served by", columns(heads, text=heads, long=heads[1:]), rows)


def phases_table(runs: Sequence[Run]) -> Table | None:
    """Parts that served each phase, by distribution; None if no record holds them."""
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in runs:
        for phase, distributions in run.facts.served():
            served = "; ".join(f"{owner}: {', '.join(parts)}" for owner, parts in distributions.items())
            groups.setdefault((run.variant, phase, served or numbers.MISSING), []).append(run)
    if not groups:
        return None
    # The phases of one method stand together, however its runs differ.
    ordered = sorted(groups.items(), key=lambda item: list(dict.fromkeys(r.variant for r in runs)).index(item[0][0]))
    rows = [row([variant, _who(group, len(runs)), phase, served]) for (variant, phase, served), group in ordered]
    heads = ["method", "runs", "phase", "provided by"]
    return Table("Phases", columns(heads, text=heads, long=(heads[1], heads[3])), rows)


def cost_table(facts: RunFacts) -> Table:
    """Times and memory of one run."""
    kind = {"rss": "growth of the resident set", "cuda": "CUDA allocator"}

    def size(value: float | None, what: str | None) -> tuple[str, str]:
        return (numbers.MISSING if value is None else f"{value / 1e6:,.0f} MB"), kind.get(what or "", "")

    def time(value: float | None) -> str:
        return numbers.MISSING if value is None else f"{numbers.seconds(value)} s"

    speed, memory = facts.speed, facts.memory
    latency = [numbers.MISSING if v is None else f"{v:.2f} ms" for v in (speed.latency_ms_median, speed.latency_ms_p95)]
    drawn = "" if speed.image_size is None else f"at {speed.image_size[0]} × {speed.image_size[1]} px"
    entries = [
        ("training", time(facts.train.train_s), f"{numbers.count(facts.train.steps)} steps"),
        ("training, with what it starts from", time(facts.train.with_pretraining_s), facts.started_from()),
        ("training memory", *size(facts.train.peak_bytes, facts.train.memory_kind)),
        ("rendering", f"{numbers.rate(speed.fps)} FPS", drawn),
        ("latency", f"{latency[0]}", f"median; 95 % of frames under {latency[1]}"),
        ("rendering memory", *size(memory.peak_render_bytes, memory.kind)),
        ("model memory", *size(memory.model_bytes, memory.kind)),
    ]
    spelt = {"s": time, "bytes": lambda value: size(value, None)[0], "": numbers.count}
    entries += [(mark.label, spelt[mark.unit](value), what) for mark, value, what in shown(facts)]
    shared = facts.train.trained_in
    notes = [f"Training is shared with rate point {shared}."] if shared and shared != facts.rate else []
    if any(value.startswith(numbers.MISSING) for _, value, _ in entries):
        notes += [f"{name}: {why}" for name, why in facts.unknown.items() if not name.startswith("metrics.")]
    if facts.contended:
        told = ", ".join(f"{phase} {share:.0%}" for phase, share in facts.contended.items())
        notes.append(f"Other processes wanted the cores meanwhile; share of them that was had: {told}.")
    heads = ["what", "measured", "how"]
    return Table("Time and memory", columns(heads, text=("what", "how")), [row(e) for e in entries], notes=notes)


def breakdown_table(facts: RunFacts) -> Table | None:
    """Training time by part of a step, if it was profiled."""
    parts = facts.train.breakdown_s
    if not parts:
        return None
    total = sum(sum(stage.values()) for stage in parts.values()) or 1.0
    rows: list[Row] = []
    for stage, seconds in parts.items():
        for name, value in seconds.items():
            label = name if len(parts) == 1 else f"{stage}: {name}"
            rows.append(row([label, numbers.seconds(value), f"{value / total:.1%}", Cell("", share=value / total)]))
    return Table("Training time by part", columns(["part of a step", "s", "share", ""], text=[""]), rows, wide=True)


def config_table(facts: RunFacts) -> Table | None:
    """Every configured value of one run, and where it was set: for what it leaves open, what was looked up."""
    if not facts.config:
        return None
    provenance = facts.config.get("provenance")
    known = provenance if isinstance(provenance, dict) else {}
    looked_up = {key: value for stage in facts.plan for key, value in stage.looked_up.items()}
    rows: list[Row] = []
    for block, values in facts.config.items():
        if block == "provenance":
            continue
        for key, value in _flat(values) if isinstance(values, dict) else [("", values)]:
            name = f"{block}.{key}" if key and block != "config" else key or block
            own = key if block in ("config", "pipeline", "scene") else name
            by = known.get(own, "default")
            if value is None and block == "config" and key in looked_up:
                value, by = looked_up[key], "looked up for the scene"
            rows.append(row([clean(name), plain(value), plain(by)]))
    return Table("Configuration", columns(["key", "value", "set by"], text=["value", "set by"], long=["value"]), rows)


def _flat(values: dict[str, Any], prefix: str = "", depth: int = 0) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        found += _flat(value, f"{name}.", depth + 1) if isinstance(value, dict) and depth < 8 else [(name, value)]
    return found
