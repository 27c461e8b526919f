"""What `sw run` prints at its end."""

import io

import pytest
from rich.console import Console
from sw_report import declared, results

from splatwizard_core.runs.record import read_record


def printed(done, width: int, *, terminal: bool = False, written=()) -> str:
    out = Console(file=io.StringIO(), width=width, highlight=False, force_terminal=terminal, color_system=None)
    results.print_results(done, written, out)
    return out.file.getvalue()


@pytest.fixture
def done(make_curve):
    """Three methods at four rate points."""
    directories = [*make_curve("toy"), *make_curve("lightgaussian", saving=0.5), *make_curve("other", saving=2.0)]
    return [(read_record(directory / "metrics.json"), directory) for directory in directories]


def rows(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if line.startswith("│")]


def test_one_table_with_a_section_for_each_method_and_the_best_marked(done):
    text = printed(done, 160)
    table = rows(text)
    assert [row[0] for row in table] == ["toy", "", "", "", "lightgaussian", "", "", "", "other", "", "", ""]
    assert [row[1] for row in table] == ["r1", "r2", "r3", "r4"] * 3
    assert text.count("├") == 2
    sizes = [row[4] for row in table]
    assert [i for i, size in enumerate(sizes) if size.startswith("*")] == [4]
    # The same quality thrice: all three of the best are marked.
    assert [i for i, row in enumerate(table) if row[2].startswith("*")] == [3, 7, 11]
    assert not any(row[-1].startswith("*") for row in table)  # equally fast: nothing is best
    assert "* best of its column" in text


def test_rate_points_of_one_method_are_not_marked(make_curve):
    done = [(read_record(d / "metrics.json"), d) for d in make_curve()]
    text = printed(done, 160)
    assert "*" not in text
    assert "BD-rate" not in text


def test_bd_rates_against_the_usual_anchor(done):
    text = printed(done, 160)
    assert "BD-rate against lightgaussian by PSNR (negative saves): other +300.0 %, toy +100.0 %" in text


@pytest.mark.parametrize("width", [60, 80, 100, 120])
def test_a_narrow_terminal_gets_fewer_columns_and_whole_numbers(done, width):
    text = printed(done, width)
    assert all(len(line) <= width for line in text.splitlines() if line[:1] in "┏┃│├└")
    assert "…" not in text
    assert all(len(row[0]) in (0, 3, 5, 13) for row in rows(text))
    assert ("no room for" in text) == (width < 100)
    heads = text.partition("┡")[0]
    assert "PSNR" in heads
    assert "MB" in heads


def test_the_curves_are_drawn_on_a_terminal_alone(done, monkeypatch):
    assert "●" not in printed(done, 100)
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding="utf-8"))
    text = printed(done, 100, terminal=True)
    assert "● lightgaussian   ■ other   ▲ toy" in text
    assert "file size, MB (logarithmic)" in text
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert "o lightgaussian   x other   v toy" in printed(done, 100, terminal=True)


def test_many_records_are_told_in_one_line(done, tmp_path):
    text = printed(done, 160, written=[tmp_path / "out/garden/rd.svg"])
    assert f"12 records: {tmp_path}/out/garden/<method>/<rate>/metrics.json" in text
    assert text.rstrip().endswith("rd.svg")
    few = printed(done[:2], 160)
    assert few.count("/metrics.json") == 2


def test_the_seconds_of_what_a_method_starts_from_count_and_are_said(make_run):
    scene = {"file": {}, "preset": "quick", "config": {}, "steps": 9, "train_s": 1800.0, "made_by": {}}

    def pruned(content):
        content["train"] = {**content["train"], "pretraining": {"3dgs": scene}, "with_pretraining_s": 1860.0}

    def given(content):
        unknown = dict.fromkeys(("preset", "config", "steps", "train_s"))
        given_scene = {**scene, **unknown, "file": {"name": "a.ply", "sha256": "00"}}
        content["train"] = {**content["train"], "pretraining": {"3dgs": given_scene}, "with_pretraining_s": None}
        content["unknown"] = {**content["unknown"], "train.with_pretraining_s": "the 3dgs scene came from a file"}

    done = []
    for method, change in (("pruned", pruned), ("given", given)):
        directory = make_run(method=method, change=change)
        done.append((read_record(directory / "metrics.json"), directory))
    text = printed(done, 160)
    assert "1860.0" in text
    assert "train s of pruned: with that of the 3dgs scene that it starts from" in text
    assert "train s of given is not known: the 3dgs scene came from a file" in text
    assert "train s of given: with" not in text


def test_further_forms_of_lpips_stand_behind_the_fields_own_and_l1(make_run):
    def with_all(content):
        scores = {"mean": 0.2, "per_view": [0.2] * 5, "direction": "lower"}
        for name in ("l1", "lpips_alex", "lpips_vgg", "lpips_vgg_3dgs", "a_strangers"):
            content["metrics"][name] = scores

    directory = make_run(change=with_all)
    text = printed([(read_record(directory / "metrics.json"), directory)], 200)
    heads = " ".join(text.partition("┡")[0].split())
    order = [heads.index(name) for name in ("PSNR", "SSIM", "3DGS", "L1", "a_strangers", "(Alex)", "MB")]
    assert order == sorted(order)


def test_times_beside_other_processes_are_marked(make_run):
    path = make_run(change=lambda c: c.update(contended={"train": 0.5}))
    told = printed([(read_record(path / "metrics.json"), path)], 200)
    assert "†" in "".join(rows(told)[0])
    assert "Other processes wanted the cores" in told


def test_no_speed_is_the_best_where_one_was_disturbed(make_run):
    def of(fps, contended):
        return lambda c: (c["speed"].update(fps=fps), c.update(contended=contended))

    quick = make_run(method="quick", change=of(20.0, {}))
    for name, contended, marked in (("idle", {}, True), ("disturbed", {"render": 0.5}, False)):
        slow = make_run(method=name, change=of(10.0, contended))
        text = printed([(read_record(path / "metrics.json"), path) for path in (quick, slow)], 200)
        assert rows(text)[0][-1].startswith("*") == marked


@pytest.mark.parametrize(
    ("encoders", "counts", "config", "wanted"),
    [
        ([("coder", "range"), ("method", "3dgs")], {"num_gaussians": 10}, {"sh_degree": 3}, 2360),
        ([("coder", "range")], {"num_gaussians": 10}, {"sh_degree": 0}, 560),
        ([("coder", "plain")], {"num_gaussians": 10}, {"sh_degree": 3}, None),  # its file is that size
        ([("coder", "range")], {"num_gaussians": 10, "num_anchors": 1}, {"sh_degree": 3}, None),
        ([("coder", "range")], {"num_gaussians": 10}, {}, None),
        ([("coder", "absent")], {"num_gaussians": 10}, {"sh_degree": 3}, None),
    ],
)
def test_float32_bytes_are_those_of_compressed_gaussians(encoders, counts, config, wanted):
    assert declared.float32_bytes(encoders, counts, config) == wanted


def test_the_size_as_float32_is_said_once_unless_a_row_has_it(make_run):
    def coded_by(coder):
        part = {"kind": "coder", "name": coder, "distribution": "sw-toy", "version": "0.1"}
        phases = [{"phase": "encode", "provided_by": [part]}]
        return lambda c: c.update(phases=phases, config={"config": {"sh_degree": 3}})

    folders = [make_run(rate=rate, change=coded_by(coder)) for rate, coder in (("r1", "range"), ("r2", "plain"))]
    done = [(read_record(folder / "metrics.json"), folder) for folder in folders]
    assert printed(done[:1], 160).count("as float32, toy would take about 0.29 MB.") == 1  # 1,234 x 236 bytes
    assert "would take" not in printed(done, 160)
