"""Tables for papers: LaTeX with booktabs, the best of each column in bold, a label to refer to."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from splatwizard_core.tooling import short_reason
from sw_report import numbers
from sw_report.aggregate import DatasetTable, comparable, dataset_tables
from sw_report.blocks import Cell, Table
from sw_report.declared import rate_position
from sw_report.marks import marked_values
from sw_report.results_tables import metric_names
from sw_report.runs import Run, natural

_SPELLED = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "–": "--", "−": "$-$", "×": r"$\times$", "·": r"$\cdot$", "†": r"\dag{}", "±": r"$\pm$",
    **{mark: f"$^{{{letter}}}$" for mark, letter in zip(numbers.MACHINES, "abcdefgh", strict=True)},
}  # fmt: skip


_ARROWS = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", "": ""}


def to_latex(tables: Sequence[tuple[str, Table]], notes: Sequence[str], runs: Sequence[Run] = ()) -> str:
    """Tables for booktabs (\\usepackage{booktabs}); what must be known stands in comments and under the table.

    runs    where they are of several data sets (or scenes), methods x data sets is the first table
    """
    blocks = [f"% {_comment(note)}\n" for note in notes]
    titles = {run.variant: run.title for run in runs}

    def named(text: str) -> str:
        """Methods as papers write them, in a text about several of them."""
        keys = "|".join(map(re.escape, sorted(titles, key=len, reverse=True)))
        return re.sub(rf"(?<![\w/.-])(?:{keys})(?![\w/.-])", lambda found: titles[found[0]], text) if keys else text

    overview = methods_by_datasets(runs)
    if overview:
        blocks.append(overview)
    labels: dict[str, int] = {}
    for title, table in tables:
        align = "".join("l" if c.text or not i else "r" for i, c in enumerate(table.columns))
        best = " Bold: the best of its column." if table.has_best else ""
        lines = [
            r"\begin{table}", r"  \centering",
            f"  \\caption{{{_latex(named(title))}. {_latex(named(table.caption))}{best}}}",
            f"  \\label{{{_label(title, labels)}}}", f"  \\begin{{tabular}}{{{align}}}", r"    \toprule",
            "    " + " & ".join(_latex(c.name) + _ARROWS[c.better] for c in table.columns) + r" \\", r"    \midrule",
        ]  # fmt: skip
        for row in table.rows:
            if row.emphasis:
                lines.append(r"    \midrule")
            first, *others = row.cells
            cells = [replace(first, text=titles.get(first.text, first.text)), *others]
            lines.append("    " + " & ".join(map(_set, cells)) + r" \\")
        lines += [r"    \bottomrule", r"  \end{tabular}"]
        lines += [f"  \\par\\smallskip\\footnotesize {_latex(_short(named(note)))}" for note in table.notes]
        blocks.append("\n".join([*lines, r"\end{table}"]) + "\n")
    return "\n".join(blocks)


def methods_by_datasets(runs: Sequence[Run]) -> str:
    """One row per method and rate point, a group of columns per data set (of one scene: that scene); "" for one group.

    Each group has PSNR, SSIM, one LPIPS where they are known, and MB. A scene that a method lacks leaves dashes.
    """
    groups = [_of_means(table) for table in dataset_tables(runs) if any(row.size is not None for row in table.rows)]
    for part in comparable(runs):
        if len({run.facts.scene for run in part}) == 1:
            groups.append(_of_scene(part))
    if len(groups) < 2:
        return ""
    at = {(run.variant, run.facts.rate): i for i, run in enumerate(sorted(runs, key=_in_order))}
    keys = sorted(dict.fromkeys(key for _, _, _, values in groups for key in values), key=at.__getitem__)
    titles = {run.variant: run.title for run in runs}
    body = [[_latex(titles[variant]), _latex(rate or numbers.MISSING)] for variant, rate in keys]
    for _, names, directions, values in groups:
        for j, name in enumerate([*names, None]):  # None: the bytes
            column = [values[key][j] if key in values else None for key in keys]
            best = marked_values(column, directions[name] if name is not None else "lower")
            for i, value in enumerate(column):
                text = _latex(numbers.megabytes(value) if name is None else numbers.score(name, value))
                body[i].append(f"\\textbf{{{text}}}" if i in best else text)
    heads, rules, left = [], [], 3
    for title, names, _, _ in groups:
        heads.append(f"\\multicolumn{{{len(names) + 1}}}{{c}}{{{_latex(title)}}}")
        rules.append(f"\\cmidrule(lr){{{left}-{left + len(names)}}}")
        left += len(names) + 1
    under = [
        _latex(numbers.heading(name)) + _ARROWS[directions[name]] if name else "MB" + _ARROWS["lower"]
        for _, names, directions, _ in groups for name in (*names, "")
    ]  # fmt: skip
    lines = [
        r"\begin{table*}", r"  \centering",
        r"  \caption{Methods by data sets: plain means over the scenes. Bold: the best of its column.}",
        r"  \label{tab:methods-by-datasets}", f"  \\begin{{tabular}}{{ll{'r' * (left - 3)}}}", r"    \toprule",
        "    & & " + " & ".join(heads) + r" \\", "    " + " ".join(rules),
        "    method & rate & " + " & ".join(under) + r" \\", r"    \midrule",
        *("    " + " & ".join(cells) + r" \\" for cells in body),
        r"    \bottomrule", r"  \end{tabular}", r"\end{table*}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _in_order(run: Run) -> tuple[object, ...]:
    rate = run.facts.rate or ""
    return natural(run.variant), rate_position(run.facts.method, rate), natural(rate)


_Key = tuple[str, str | None]
_Group = tuple[str, list[str], dict[str, str], dict[_Key, list[float | None]]]


def _of_means(table: DatasetTable) -> _Group:
    names = _shown({name for row in table.rows for name, value in row.metrics.items() if value is not None})
    values = {(r.variant, r.rate): [*(r.metrics[name] for name in names), r.size] for r in table.rows}
    return table.title, names, table.directions, values


def _of_scene(runs: Sequence[Run]) -> _Group:
    names = _shown(set(metric_names(runs)))
    values = {(r.variant, r.facts.rate): [*map(r.mean, names), r.size] for r in runs}
    directions = {name: metric.direction for run in runs for name, metric in run.facts.metrics.items()}
    return runs[0].facts.scene, names, directions, values


def _shown(names: set[str]) -> list[str]:
    """PSNR, SSIM and the field's LPIPS of these metrics."""
    lpips = numbers.main_lpips(names)
    return [name for name in numbers.ordered_metrics(names) if name in ("psnr", "ssim", lpips)]


def _label(title: str, taken: dict[str, int]) -> str:
    """A label that no other table has."""
    name = re.sub(r"[^a-z0-9]+", "-", title.partition(", protocol ")[0].lower()).strip("-") or "table"
    taken[name] = taken.get(name, 0) + 1
    return f"tab:{name}" + (f"-{taken[name]}" if taken[name] > 1 else "")


def _short(note: str) -> str:
    """A note without advice on commands and what to install: papers have no use for it."""
    names, colon, reason = re.sub(r" \(`sw [^`]*`\)", "", note).partition(": ")
    return f"{names}{colon}{short_reason(reason)}"


def _comment(text: str) -> str:
    return " ".join(text.split())


def _set(cell: Cell) -> str:
    return f"\\textbf{{{_latex(cell.text)}}}" if cell.best else _latex(cell.text)


def _latex(text: str) -> str:
    return "".join(_SPELLED.get(character, character) for character in text)
