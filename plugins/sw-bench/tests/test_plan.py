"""Plans: what they hold, how tables override each other, and what is said of wrong ones."""

from __future__ import annotations

import pytest
from sw_bench.plan import Values, checked_plan, read_plan, set_words

from splatwizard_core.api import ConfigError

WHOLE = """
methods = ["3dgs", "hac", "hac-small"]
scenes = ["demo", "demo:tiny"]
rates = ["r1", "r3"]
seeds = [0, 1]
set.resolution = 2

[method.hac]
preset = "quick"

[method.hac-small]
method = "hac"
rates = "r1"
set = { anchors = { voxel = 0.1 }, resolution = 4 }

[scene."demo:tiny"]
images = "images_2"
set.resolution = 1

[[override]]
methods = ["hac-small"]
scenes = ["demo:tiny"]
set."anchors.voxel" = 0.2

[[override]]
methods = ["3dgs"]
seeds = [1]
skip = true
"""


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "plan.toml"
        path.write_text(text)
        return path

    return write


def test_later_tables_win_and_values_are_merged_by_key(written):
    plan, text = read_plan(written(WHOLE))
    assert text == WHOLE
    assert [plan.method_of(label) for label in plan.methods] == ["3dgs", "hac", "hac"]
    assert plan.values_for("hac", "demo", 0) == Values(rates="r1,r3", preset="quick", set={"resolution": 2})
    tiny = plan.values_for("hac-small", "demo:tiny", 1)
    assert tiny == Values(rates="r1", images="images_2", set={"resolution": 1, "anchors.voxel": 0.2})
    assert plan.values_for("3dgs", "demo", 1) is None
    assert plan.values_for("3dgs", "demo", 0) is not None


def test_a_part_of_a_plan_is_chosen_by_name(written):
    plan, _ = read_plan(written(WHOLE))
    part = plan.part(["hac"], [], [1])
    assert (part.methods, part.scenes, part.seeds) == (("hac",), plan.scenes, (1,))
    with pytest.raises(ConfigError, match="no method of the plan is called 'hca': did you mean 'hac'"):
        plan.part(["hca"], [], [])


def test_values_are_spelled_as_on_the_command_line():
    values = {"a": True, "b.c": 0.5, "d": [1, 2], "e": "none"}
    assert set_words(values) == ["a=true", "b.c=0.5", "d=[1, 2]", "e=none"]


HEAD = 'methods = ["3dgs"]\nscenes = ["demo"]\n'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("methods = [", "is not valid TOML"),
        ('method = ["3dgs"]\nscenes = ["demo"]', "bad value ['3dgs'] for 'method'"),
        ("", "`methods` is empty: there is nothing to run"),
        ('methods = ["3dgs"]\nscenes = []', "`scenes` is empty: there is nothing to run"),
        (HEAD + "seeds = []", "`seeds` is empty: there is nothing to run"),
        (HEAD + "seeds = [-1]", "a seed is a whole number of 0 or more"),
        (HEAD + "seeds = [2.0]", "bad value 2.0 for 'seeds.0': a seed is a whole number"),
        (HEAD + "seeds = [true]", "bad value True for 'seeds.0': a seed is a whole number"),
        (HEAD + f"seeds = [{10**26}]", "a seed is a whole number of 0 or more, of at most 63 bits"),
        (HEAD + f"seeds = {list(range(5001))}", "5,001 runs (methods x scenes x seeds) and 0 overrides; 5,000 and"),
        (HEAD + "[[override]]\n" * 1001, "1 runs (methods x scenes x seeds) and 1,001 overrides"),
        (HEAD + f"x = {'[' * 100_000}", "its brackets are nested too deeply"),
        (HEAD + "seeds = [1, 2, 1]", "'1' stands twice in `seeds`"),
        (HEAD + "sedes = [1]", "unknown key 'sedes': did you mean 'seeds'?"),
        (HEAD + "[method.3dgs]\nrate = 'r1'", "unknown key 'method.3dgs.rate': did you mean 'rates'?"),
        (HEAD + "[method.hac]\nrates = 'r1'", "[method.hac] is for none of `methods`: there are 3dgs"),
        (HEAD + "[scene.dmo]\nrates = 'r1'", "[scene.dmo] is for none of `scenes`: did you mean 'demo'?"),
        (HEAD + "[[override]]\nscenes = ['dem']", "override 1: 'dem' is none of `scenes`: did you mean 'demo'?"),
        (HEAD + "[[override]]\nseeds = [1]", "override 1: '1' is none of `seeds`: there are 0"),
        (HEAD + "set.seed = 3", "`seeds` of the plan gives the seeds"),
        (HEAD + "repeats = 0", "bad value 0 for 'repeats'"),
        ('methods = ["3dgs", "3dgs"]\nscenes = ["demo"]', "'3dgs' stands twice in `methods`"),
        ('methods = ["../x"]\nscenes = ["demo"]', "'../x' in `methods` cannot be the name of a folder"),
    ],
)
def test_wrong_plans_are_told_in_a_line(written, text, told):
    with pytest.raises(ConfigError) as caught:
        read_plan(written(text))
    assert told in str(caught.value)
    assert str(caught.value).startswith(str(written(text)))
    assert "\n" not in str(caught.value)


def test_a_plan_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot read the plan .*nowhere.toml: No such file"):
        read_plan(tmp_path / "nowhere.toml")
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="is not valid TOML"):
        read_plan(path)


@pytest.mark.parametrize("seeds", [[2.0], list(range(5001)), ["1"], [True]])
def test_seeds_are_whole_numbers_and_not_thousands(seeds):
    with pytest.raises(ConfigError, match="seeds"):
        checked_plan({"methods": ["3dgs"], "scenes": ["demo:tiny"], "seeds": seeds}, "plan")
