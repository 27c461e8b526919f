"""Runs that differ in anything but rate and seed are never joined; seeds become mean and standard deviation."""

import csv
import io
import json
import statistics

import pytest
from sw_report import declared, exports
from sw_report.aggregate import dataset_tables
from sw_report.configurations import configurations
from sw_report.distortion import bd_tables
from sw_report.page import PageOptions, render_page
from sw_report.results_tables import means_table, runs_table
from sw_report.runs import OF_SEEDS, collect

from splatwizard_core.cli.main import main

RATES = {"r1": 0.3, "r2": 0.2, "r3": 0.1, "r4": None}


def configured(rate, *, seed=None, preset="paper", pipeline=(), by="rate", more=(), **given):
    """Change of a record: rate points set `prune.share` (r4 leaves it at its default), --set what is `given`."""
    share = RATES[rate]
    config = {"iterations": 300, "prune": {"share": 0.05 if share is None else share, "start": 5}, **dict(more)}
    provenance: dict[str, str] = dict.fromkeys(dict(pipeline), "--set")
    provenance |= {} if share is None else {"prune.share": f"rate '{rate}'" if by == "rate" else by}
    for key, value in given.items():
        block = config
        *path, last = key.split("__")
        for name in path:
            block = block[name]
        block[last] = value
        provenance[key.replace("__", ".")] = "--set" if by == "rate" else by
    if by not in ("rate", "--set"):  # a file says every key
        provenance |= {"iterations": by, "prune.share": by, "prune.start": by}

    def change(content):
        content["config"] = {
            "config": config, "pipeline": {"seed": 0 if seed is None else seed, "threads": 0, **dict(pipeline)},
            "provenance": provenance,
        }  # fmt: skip
        content["preset"] = preset

    return change


@pytest.fixture
def make(make_run, tmp_path):
    """make(rate, folder, noise, **of configured) -> its directory below tmp_path/<folder>."""

    def make_it(rate, folder="a", noise=8.0, size=None, scene="garden", **named):
        return make_run(rate, noise, out=tmp_path / folder, scene=scene, size=size or 1000 * int(rate[1:]),
                        change=configured(rate, **named))  # fmt: skip

    return make_it


def labels(path):
    return [run.label for run in collect([path]).runs]


def test_rate_points_of_one_configuration_are_one_curve(make, tmp_path):
    for rate in RATES:
        make(rate)
    found = collect([tmp_path])
    assert [run.label for run in found.runs] == ["toy r1", "toy r2", "toy r3", "toy r4"]
    assert found.notes == []


def test_runs_that_differ_in_more_than_the_rate_are_two_curves_and_it_is_said(make, tmp_path):
    for rate in RATES:
        make(rate, "a", iterations=100)
    for rate in ("r3", "r4"):
        make(rate, "b", size=5000, iterations=600)
    found = collect([tmp_path])
    assert [run.label for run in found.runs] == [
        "toy (iterations 100) r1", "toy (iterations 100) r2", "toy (iterations 100) r3", "toy (iterations 100) r4",
        "toy (iterations 600) r3", "toy (iterations 600) r4",
    ]  # fmt: skip
    assert found.notes == ["runs of toy differ in more than the rate, and stand apart: iterations"]


@pytest.mark.parametrize(
    ("one", "other", "names"),
    [
        ({}, {"prune__start": 9}, {"toy (prune.start default)", "toy (prune.start 9)"}),
        ({}, {"prune__share": 0.5}, {"toy (prune.share default)", "toy (prune.share 0.5)"}),
        ({}, {"preset": "quick"}, {"toy (paper)", "toy (quick)"}),
        ({}, {"pipeline": {"random_background": True}.items()},
         {"toy (random_background default)", "toy (random_background true)"}),
        ({}, {"a": 1, "b": 2, "c": 3, "d": 4}, {"toy (configuration 1)", "toy (configuration 2)"}),
    ],
)  # fmt: skip
def test_whatever_may_change_a_result_tells_apart(make, tmp_path, one, other, names):
    make("r1", "one", **one)
    make("r2", "other", **other)
    assert {run.variant for run in collect([tmp_path]).runs} == names


@pytest.mark.parametrize("key", ["threads", "device", "log_every", "profile"])
def test_what_changes_no_result_tells_nothing_apart(make, tmp_path, key):
    make("r1", pipeline={key: 1}.items())
    make("r2", pipeline={key: 2}.items())
    assert labels(tmp_path) == ["toy r1", "toy r2"]


def test_a_key_that_an_older_record_lacks_has_its_default(make, tmp_path):
    make("r1")
    make("r2", more={"new": {"switch": False}}.items())
    assert labels(tmp_path) == ["toy r1", "toy r2"]
    make("r3", new=True)
    assert len({run.variant for run in collect([tmp_path]).runs}) == 2


def test_values_that_a_preset_chooses_by_the_scene_tell_no_scenes_apart(make, tmp_path):
    for scene, start in (("garden", 7), ("bicycle", 9)):
        make("r1", scene=scene, more=[("prune", {"share": 0.3, "start": start}), ("grid", start)])
    assert set(labels(tmp_path)) == {"toy r1"}
    make("r1", "b", scene="bonsai", grid=3, more=[("grid", 3)])
    assert len(set(labels(tmp_path))) == 3


def test_a_run_made_again_from_its_own_configuration_file_belongs_to_the_others(make, tmp_path):
    for rate in ("r1", "r2", "r3"):
        make(rate, "first")
    make("r3", "again", by="first/config.toml", size=3500)
    found = collect([tmp_path])
    assert {run.variant for run in found.runs} == {"toy"}
    assert "2 runs of toy r3" in found.notes[0]


def test_runs_from_files_alone_ask_the_installed_method_what_its_rates_are(make, tmp_path, monkeypatch):
    def settings(method, preset, rate):
        return {"prune.share"}, {"prune": {"share": RATES[rate]}}

    for rate in ("r1", "r2"):
        make(rate, by=f"{rate}/config.toml")
    assert len({run.variant for run in collect([tmp_path]).runs}) == 2  # nobody knows what the rate decides
    monkeypatch.setattr("sw_report.configurations.rate_settings", settings)
    assert labels(tmp_path) == ["toy r1", "toy r2"]


def test_the_rates_of_a_method_that_cannot_be_loaded_are_unknown():
    assert declared.rate_settings("3dgs", "paper", "r1") == declared.rate_settings("none", None, None) == (set(), {})


@pytest.mark.parametrize("config", [{"config": 3, "provenance": [1]}, {"config": {"a": {"": [{}]}}, "scene": None}])
def test_configurations_of_strangers_are_read_without_harm(make_run, tmp_path, config):
    for rate in ("r1", "r2"):
        make_run(rate, change=lambda content: content.update(config=config))
    assert labels(tmp_path) == ["toy r1", "toy r2"] or labels(tmp_path) == ["toy r2", "toy r1"]
    assert configurations([run.facts for run in collect([tmp_path]).runs])[0]["preset"] == '"paper"'


@pytest.fixture
def seeded(make, tmp_path):
    """Three seeds of r1 and r2 on two scenes."""
    for scene in ("garden", "room"):
        for seed, noise in enumerate((8.0, 9.0, 10.0)):
            for rate in ("r1", "r2"):
                make(rate, f"seed{seed}", noise / int(rate[1:]), scene=scene, seed=seed, size=1000 + 10 * seed
                     if rate == "r1" else 2000)  # fmt: skip
    return tmp_path


def test_seeds_are_one_row_with_mean_deviation_and_number(seeded):
    runs = collect([seeded]).runs
    assert [run.label for run in runs] == ["toy r1", "toy r2"] * 2
    first = runs[0]
    psnr = [json.loads((seeded / f"seed{i}/garden/toy/r1/metrics.json").read_text())["metrics"]["psnr"]["mean"]
            for i in range(3)]  # fmt: skip
    assert (first.mean("psnr"), first.deviation("psnr")) == pytest.approx((statistics.mean(psnr),
                                                                           statistics.stdev(psnr)))  # fmt: skip
    assert first.size == 1010
    table = runs_table(runs[:2])
    row = dict(zip([column.name for column in table.columns], table.rows[0].cells, strict=True))
    assert row["seeds"].text == "3"
    assert row["PSNR dB"].text == f"{statistics.mean(psnr):.2f} ± {statistics.stdev(psnr):.2f}"
    assert any("standard deviation" in note for note in table.notes)


def test_seeds_of_several_arguments_are_joined_too(seeded):
    runs = collect([seeded / f"seed{i}" for i in range(3)]).runs
    assert {len(run.seeds) for run in runs} == {3}


def test_means_over_scenes_deviate_over_the_seeds(seeded):
    (table,) = dataset_tables(collect([seeded]).runs)
    row = table.rows[0]
    by_seed = [
        statistics.mean(
            json.loads((seeded / f"seed{i}/{scene}/toy/r1/metrics.json").read_text())["metrics"]["psnr"]["mean"]
            for scene in ("garden", "room")
        )
        for i in range(3)
    ]
    assert row.seeds == 3
    assert row.deviations["psnr"] == pytest.approx(statistics.stdev(by_seed))
    assert " ± " in means_table(table).rows[0].cells[4].text


def test_a_value_that_one_seed_lacks_has_no_mean(seeded):
    path = seeded / "seed1/garden/toy/r1/metrics.json"
    content = json.loads(path.read_text())
    content["metrics"]["psnr"]["mean"] = None
    path.write_text(json.dumps(content))
    run = collect([seeded]).runs[0]
    assert (run.mean("psnr"), run.deviation("psnr")) == (None, None)
    assert run.deviation("ssim") is not None


def test_machine_readable_forms_tell_seeds(seeded, capsys):
    assert main(["report", str(seeded), "--json"]) == 0
    run = json.loads(capsys.readouterr().out)["runs"][0]
    assert run["seeds"] == [0, 1, 2]
    assert run["deviations"]["psnr"] > 0
    assert main(["report", str(seeded), "--jsonl"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 12
    assert len({line["directory"] for line in lines}) == 12
    (row, *_) = csv.DictReader(io.StringIO(exports.to_csv(collect([seeded]).runs)))
    assert (row["Seeds"], row["LPIPS deviation"]) == ("3", "")
    assert float(row["PSNR deviation"]) == pytest.approx(run["deviations"]["psnr"], abs=1e-5)


def test_bd_rates_go_by_the_means_of_seeds(make_curve, tmp_path):
    for seed, saving in ((1, 0.4), (2, 0.6)):
        make_curve("3dgs", out=tmp_path / str(seed), change=configured("r4", seed=seed))
        make_curve("toy", saving, out=tmp_path / str(seed), change=configured("r4", seed=seed))
    runs = collect([tmp_path]).runs
    assert bd_tables(runs, "3dgs")[0].rows[0].rate.value == pytest.approx(-50)


def test_the_page_about_the_seeds_of_one_rate_point_shows_their_mean(make, tmp_path):
    for seed, noise in enumerate((6.0, 12.0)):
        make("r1", f"seed{seed}", noise, seed=seed)
    collection = collect([tmp_path])
    assert collection.notes == [OF_SEEDS]
    text = render_page(collection, PageOptions(pictures=False))
    (run,) = collection.runs
    assert f"{run.mean('psnr'):.2f} ±\N{NO-BREAK SPACE}{run.deviation('psnr'):.2f}" in text
    assert "2 runs: 1 method on 1 scene" in text
    assert text.count("sw run --method toy --scene garden --preset paper --rate r1") == 2


def test_values_by_data_set_make_no_configurations(make_run, tmp_path):
    for scene, voxel in (("garden", 0.001), ("train", 0.01)):

        def change(content, voxel=voxel):
            configured("r1", more=(("voxel_size", voxel),))(content)
            content["config"]["provenance"]["voxel_size"] = "data set 'x'"

        make_run("r1", 8.0, out=tmp_path, scene=scene, change=change)
    assert labels(tmp_path) == ["toy r1", "toy r1"]
