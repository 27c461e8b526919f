"""From a plan to runs and processes: what each is made with, where it lies, and what is trained once for several."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sw_bench.cells import Layout, cells_of, differing_bases, jobs_of, prepare, run_job, training_key
from sw_bench.estimates import Estimates
from sw_bench.plan import checked_plan
from sw_bench.probe import probe_into
from sw_bench.state import left_to_do

from splatwizard_core.api import ConfigError
from splatwizard_core.tooling import load_plugins, write_json

pytest.importorskip("sw_lightgaussian", reason="the plans need methods that start from a trained scene")
SHORT = {"iterations": 20, "pretrained.iterations": 20}


def planned(tmp_path, *, seed_folders=True, **tables):
    """Runs and processes of a plan on the smallest scene."""
    plugins, layout = load_plugins(), Layout(tmp_path, seed_folders)
    plan = checked_plan({"scenes": ["demo:tiny"], "rates": "r1", "set": SHORT, **tables}, "the test")
    cells = cells_of(plan, layout, plugins)
    return cells, jobs_of(cells, layout, plugins), layout


def test_rate_points_of_one_training_share_a_process(tmp_path):
    cells, jobs, _ = planned(tmp_path, methods=["3dgs"], rates="all", seeds=[0, 3])
    assert [len(job.cells) for job in jobs] == [len(cells) // 2] * 2
    assert [cell.directory for cell in jobs[1].cells][:2] == [
        tmp_path / "seed-3" / "demo-tiny" / "3dgs" / rate for rate in ("r1", "r2")
    ]
    assert jobs[1].words[jobs[1].words.index("--seed") + 1] == "3"
    assert jobs[1].words[-2:] == ("--rate", "r1,r2,r3,r4,r5,r6")


def test_what_methods_start_from_is_trained_once_and_first(tmp_path):
    _, jobs, _ = planned(tmp_path, methods=["3dgs", "lightgaussian", "mesongs"], seeds=[0, 1])
    shared = [job for job in jobs if job.shared is not None]
    assert [job.name for job in shared] == [f"3dgs demo:tiny seed {n} (training for several)" for n in (0, 1)]
    assert jobs[:2] == shared
    for job in jobs[2:]:
        assert job.needs == (shared[job.cells[0].seed],)
    assert [job.trains for job in jobs[2:4]] == [False, True]  # 3dgs itself takes it as its own
    for job in shared:
        assert job.shared is not None
        assert (job.shared.resolved.method, job.shared.resolved.config.iterations) == ("3dgs", 20)


def test_what_one_method_alone_starts_from_it_trains_itself(tmp_path):
    _, jobs, _ = planned(tmp_path, methods=["lightgaussian"])
    assert [(job.shared, job.needs, job.trains) for job in jobs] == [(None, (), True)]


def test_other_values_of_what_is_started_from_are_another_training(tmp_path):
    _, jobs, _ = planned(
        tmp_path, methods=["3dgs", "lightgaussian"], method={"lightgaussian": {"set": {"pretrained.iterations": 30}}}
    )
    assert [job.shared for job in jobs] == [None, None]


def test_a_variant_has_a_root_of_its_own_and_shares_the_trained_scenes(tmp_path):
    variant = {"coarse": {"method": "lightgaussian", "set": {"prune.percent": 0.8}}}
    cells, jobs, layout = planned(tmp_path, methods=["lightgaussian", "coarse"], method=variant)
    assert [cell.root for cell in cells] == [tmp_path / "seed-0", tmp_path / "seed-0-coarse"]
    assert [job.shared is not None for job in jobs] == [True, False, False]
    prepare(jobs, layout)
    (tmp_path / "seed-0" / ".trained" / "x").mkdir()
    assert (tmp_path / "seed-0-coarse" / ".trained" / "x").is_dir()
    assert (tmp_path / "seed-0-coarse" / ".trained").readlink().as_posix() == "../seed-0/.trained"
    assert jobs[0].shared is not None
    assert 'method = "3dgs"' in jobs[0].shared.file.read_text()
    prepare(jobs, layout)  # a second time changes nothing


def test_a_tiny_scene_gets_the_preset_quick_in_the_sweep_as_in_its_processes(tmp_path, capsys):
    """A folder whose pictures have few pixels: what the sweep expects is what `sw run` makes with these words."""
    from splatwizard_core.cli.main import main

    assert main(["data", "synth", str(tmp_path / "few"), "--size", "tiny"]) == 0
    cells, jobs, _ = planned(
        tmp_path, methods=["3dgs", "lightgaussian", "mesongs"], scenes=[str(tmp_path / "few")], set={}
    )
    assert [cell.resolved.preset for cell in cells] == ["quick"] * 3
    assert [cell.words[cell.words.index("--preset") + 1] for cell in cells] == ["quick"] * 3
    assert [job.shared.resolved.preset for job in jobs if job.shared] == ["quick"]
    assert capsys.readouterr().err.count("preset quick: ") == 1
    asked, _, _ = planned(tmp_path, methods=["3dgs"], scenes=[str(tmp_path / "few")], set={}, preset="paper")
    assert asked[0].resolved.preset == "paper"


def test_a_configuration_file_gives_what_the_plan_leaves_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (cell,), _, _ = planned(tmp_path, methods=["3dgs"], rates="r2")
    (tmp_path / "config.toml").write_text(cell.resolved.toml())
    (again,), (job,), _ = planned(
        tmp_path, methods=["3dgs"], rates=None, set={}, config="config.toml", scenes=["demo:tiny"]
    )
    assert again.resolved.config_hash() == cell.resolved.config_hash()
    words = [*job.words]
    options = {word: words[i + 1] for i, word in enumerate(words) if word in ("--config", "--method", "--rate")}
    assert options == {"--config": str(tmp_path / "config.toml"), "--method": "3dgs", "--rate": "r2"}


def test_a_single_seed_needs_no_folder_of_its_own(tmp_path):
    cells, _, _ = planned(tmp_path, seed_folders=False, methods=["3dgs"])
    assert [cell.directory for cell in cells] == [tmp_path / "demo-tiny" / "3dgs" / "r1"]


def test_keys_of_trained_scenes_are_for_the_methods_that_start_from_one(tmp_path):
    cells, _, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"])
    assert ["pretrained.iterations=20" in cell.words for cell in cells] == [False, True]
    with pytest.raises(ConfigError, match="3dgs on demo:tiny: method '3dgs' does not start from a trained scene"):
        planned(tmp_path, methods=["3dgs"], set={}, method={"3dgs": {"set": {"pretrained.iterations": 5}}})


def test_what_a_plan_says_of_all_methods_also_trains_what_they_start_from(tmp_path, capsys):
    cells, jobs, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={"iterations": 20})
    assert dict(cells[1].resolved.pretrained) == {"iterations": 20}
    assert [job.shared is not None for job in jobs] == [True, False, False]  # 3dgs itself is that scene
    assert not differing_bases(cells, load_plugins())
    assert "lightgaussian: the trained scene that it starts from has iterations=20 too" in capsys.readouterr().err


def test_trainings_for_several_have_names_of_their_own(tmp_path):
    """A job goes by its name, and so does the file of its output."""
    overrides = [
        {"methods": [label], "set": {**SHORT, "pretrained.iterations": steps}}
        for steps, labels in ((10, ("a", "b")), (20, ("c", "d"))) for label in labels
    ]  # fmt: skip
    method = {label: {"method": "lightgaussian"} for label in "abcd"}
    _, jobs, _ = planned(tmp_path, methods=[*"abcd"], method=method, override=overrides)
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    assert {f"3dgs demo:tiny seed 0 (training for several) {n} of 2" for n in (1, 2)} < set(names)


def test_a_finished_training_for_several_is_no_process_to_go(tmp_path):
    _, jobs, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={"iterations": 20})
    shared = jobs[0].shared
    assert [len(left_to_do(jobs)), jobs[2].needs] == [3, (jobs[0],)]
    (home := tmp_path / "home").mkdir()
    write_json(home / "steps.json", {"train": {}})
    shared.note.parent.mkdir(parents=True)
    write_json(shared.note, {"directory": str(home)})
    assert len(left_to_do(jobs, {training_key(shared.resolved)})) == 3  # about to be discarded
    assert left_to_do(jobs) == jobs[1:]
    assert [job.needs for job in jobs[1:]] == [(), ()]


@pytest.mark.parametrize("where", ["scene", "override"])
def test_so_does_what_is_said_of_all_methods_on_one_scene(where, tmp_path):
    values = {"set": {"iterations": 20}}
    table = {"demo:tiny": values} if where == "scene" else [{"scenes": ["demo:tiny"], **values}]
    cells, _, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={}, **{where: table})
    assert dict(cells[1].resolved.pretrained) == {"iterations": 20}


def test_so_does_what_is_said_of_one_method_and_nothing_that_only_encodes(tmp_path):
    own = {"lightgaussian": {"set": {"iterations": 20}}}
    cells, _, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={}, method=own)
    assert dict(cells[1].resolved.pretrained) == {"iterations": 20}
    (cell,), _, _ = planned(tmp_path, methods=["lightgaussian"], set={"iterations": 20})
    assert cell.resolved.pretrained == cells[1].resolved.pretrained
    cells, _, _ = planned(tmp_path, methods=["3dgs", "spz"], set={"codec": "gaussians-exact"})
    assert not cells[1].resolved.pretrained


def test_runs_that_start_from_differently_trained_scenes_are_told(tmp_path):
    own = {"3dgs": {"set": {"iterations": 20}}}
    cells, _, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={}, preset="paper", method=own)
    assert differing_bases(cells, load_plugins()) == [
        "demo:tiny: the trained 3dgs scenes differ: iterations=30000 for lightgaussian; iterations=20 for 3dgs"
    ]
    variants = {"a": {"method": "3dgs", "set": {"iterations": 20}}}
    cells, _, _ = planned(tmp_path, methods=["3dgs", "a"], set={}, method=variants)
    assert not differing_bases(cells, load_plugins())  # they differ on purpose


def test_the_same_values_make_the_same_run_and_only_those(tmp_path):
    (cell,), (other,), (rated,) = (
        planned(tmp_path, methods=["3dgs"], set=values)[0]
        for values in ({"iterations": 20}, {"iterations": 21}, {"iterations": 20, "codec.name": "gaussians-zstd"})
    )
    again = planned(tmp_path, methods=["3dgs"], set={"iterations": "20"})[0][0]
    assert (cell.training, cell.resolved.config_hash()) == (again.training, again.resolved.config_hash())
    assert cell.training != other.training
    assert cell.training == rated.training
    assert cell.resolved.config_hash() != rated.resolved.config_hash()


def test_names_of_output_files_are_plain(tmp_path):
    (cell,), _, _ = planned(tmp_path, methods=["3dgs"])
    assert run_job([replace(cell, scene="../a b/ü")]).log == "3dgs_.._a_b_ü_seed_0_r1.log"


@pytest.mark.pipeline
def test_a_probe_measures_the_first_steps_and_writes_nothing(tmp_path, capsys):
    _, jobs, _ = planned(tmp_path, methods=["3dgs", "lightgaussian"], set={}, device="cpu")
    estimates = Estimates()
    probe_into(estimates, jobs)
    told = capsys.readouterr().err
    assert "3dgs (training) on demo:tiny: 1,100 steps of " in told
    assert "lightgaussian on demo:tiny: " in told
    by_name = {job.about[0]: estimates.of(job) for job in jobs}
    assert by_name["3dgs"] == 0.0  # its training is that of the others
    assert by_name["3dgs (training)"] > 0
    assert by_name["lightgaussian"] > 0
    assert list(tmp_path.iterdir()) == []
