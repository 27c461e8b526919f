"""What is read of records: of this release, of others, and of none."""

import json
import re
from pathlib import Path
from typing import Annotated

import pytest
from pydantic import Field
from sw_report.facts import LARGEST_RECORD, LONGEST_TEXT, RunFacts, clean, read_facts
from sw_report.results_tables import cost_table
from sw_report.runs import collect

from splatwizard_core.base.block import Shown
from splatwizard_core.errors import UserInputError
from splatwizard_core.evaluation.speed import SpeedBlock


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_record_of_today_is_read_without_remark(make_run):
    facts, notes = read_facts(make_run("r3", size=5000) / "metrics.json")
    assert notes == []
    assert (facts.method, facts.rate, facts.scene, facts.file.bytes) == ("toy", "r3", "garden", 5000)
    assert facts.train.steps == 300
    assert facts.speed.fps == 12.5
    assert facts.rules()["resolution"] == -1


def test_a_field_that_is_marked_to_be_shown_needs_nothing_else(make_run):
    class MoreSpeed(SpeedBlock):
        slowest_s: Annotated[float | None, Shown("slowest frame", "s")] = Field(None, description="of all frames")

    class More(RunFacts):
        speed: MoreSpeed = MoreSpeed()

    content = json.loads((make_run() / "metrics.json").read_text())
    content["speed"]["slowest_s"] = 1.25
    rows = {row.cells[0].text: [cell.text for cell in row.cells[1:]] for row in cost_table(More(**content)).rows}
    assert rows["slowest frame"] == ["1.25 s", "of all frames"]
    assert rows["encoding"] == ["0.10 s", "to the closed file"]


def test_an_older_record_is_read_and_its_schema_told(make_run):
    def age(content):
        content["schema_version"] = 1
        for block, names in {"speed": ("jit_s", "load_s", "spread", "repeats"), "memory": ("peak_load_bytes",)}.items():
            for name in names:
                del content[block][name]

    facts, notes = read_facts(make_run(change=age) / "metrics.json")
    assert facts.speed.fps == 12.5
    assert len(notes) == 1
    assert notes[0].startswith("record of schema 1,")


def test_a_newer_record_is_read_as_far_as_it_is_understood(make_run):
    def renew(content):
        content["schema_version"] = 99
        content["hologram"] = {"depth": 3}
        content["speed"] = {"fps": {"median": 12.0}}

    facts, notes = read_facts(make_run(change=renew) / "metrics.json")
    assert facts.speed.fps is None
    assert facts.metrics["psnr"].mean > 20
    assert notes[0].startswith("record of schema 99,")
    assert notes[1] == "'speed' of its record is not understood and left out"


@pytest.mark.parametrize("wrong", [3, [["depth", 14]], "depth"])
def test_a_plan_whose_looked_up_values_are_none_is_left_out(make_run, wrong):
    facts, notes = read_facts(make_run(change=lambda c: c.update(plan=[{"looked_up": wrong}])) / "metrics.json")
    assert facts.plan == []
    assert notes == ["'plan' of its record is not understood and left out"]


@pytest.mark.parametrize("name", ["method", "scene", "protocol", "file", "metrics"])
def test_what_is_indispensable_is_named_when_missing(make_run, name):
    directory = make_run(change=lambda content: content.pop(name))
    with pytest.raises(UserInputError, match=rf"metrics\.json: not a result record: {name}: Field required"):
        read_facts(directory / "metrics.json")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "not a result record"),
        ("[1]", "it holds no object"),
        ("[" * 200_000, "not a result record"),
        ('{"method": NaN}', "not a result record: method"),
        ("\ud800".encode("utf-8", "surrogatepass"), "not a result record"),
    ],
)
def test_what_is_no_record_is_said_in_one_line(tmp_path, text, complaint):
    path = tmp_path / "metrics.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserInputError, match=complaint) as error:
        read_facts(path)
    assert str(path) in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_size_of_nothing_and_infinite_numbers_are_refused(make_run):
    directory = make_run(change=lambda content: content["file"].update(bytes=0))
    with pytest.raises(UserInputError, match=r"file\.bytes"):
        read_facts(directory / "metrics.json")
    directory = make_run("r2", change=lambda content: content["metrics"]["psnr"].update(mean=float("inf")))
    with pytest.raises(UserInputError, match=r"metrics\.psnr\.mean"):
        read_facts(directory / "metrics.json")


HOSTILE = {
    "an integer of 400 digits": (lambda c: c["speed"].update(fps=10**400), r"an integer of 401 digits"),
    "one among the rest": (lambda c: c["config"].update(x=[10**400]), r"an integer of 401 digits"),
    "240,000 view names": (lambda c: c.update(views=[f"v{i}" for i in range(240_000)]), r"240,000 items; 20,000 are"),
    "many sections": (lambda c: c["file"].update(sections=dict.fromkeys(map(str, range(30_000)), 1)), r"30,000 items"),
    "a score beyond all": (lambda c: c["metrics"]["psnr"].update(mean=1e308), r"metrics\.psnr\.mean"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_record_is_left_out_and_the_others_are_shown(make_run, name):
    change, told = HOSTILE[name]
    make_run("r1", change=change)
    good = make_run("r2")
    found = collect([good.parent])
    assert [run.directory for run in found.runs] == [good]
    (note,) = (note for note in found.notes if note.startswith("left out"))
    assert re.search(told, note)
    assert len(note) < 500


def test_a_record_of_many_bytes_is_not_read(make_run):
    directory = make_run()
    with (directory / "metrics.json").open("r+b") as file:
        file.truncate(LARGEST_RECORD + 1)
    with pytest.raises(UserInputError, match="16,000,001 bytes is too large"):
        read_facts(directory / "metrics.json")


def test_text_cannot_reorder_or_hide_what_stands_around_it():
    assert clean("a\u202eb\x1b[2Jc\u200bd\n") == "a\ufffdb\ufffd[2Jc\ufffdd\ufffd"
    assert clean("Gärten & <b>") == "Gärten & <b>"
    assert len(clean("x" * 10_000)) == LONGEST_TEXT
