"""How plugins behave as really installed distributions: broken, clashing, restricted, incomplete."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

GOOD = """
    from splatwizard_core.api import hookimpl

    @hookimpl
    def register_metrics(registry):
        registry.add("mean", "{module}:mean", summary="mean of the render", direction="higher")

    def mean(render, truth):
        return float(render.mean())
"""


def good(make_plugin, name: str, **kwargs) -> Path:
    return make_plugin(name, GOOD.format(module=name.replace("-", "_")), **kwargs)


def test_a_plugin_is_listed_with_what_it_provides(core, make_plugin):
    core.install(good(make_plugin, "sw-good", version="1.2"))
    listed = core.plugins()["sw-good"]
    assert listed["version"] == "1.2"
    assert listed["error"] is None
    assert [(e["kind"], e["name"]) for e in listed["provides"]] == [("metric", "mean")]


def test_a_plugin_that_fails_to_import_is_listed_with_its_reason_and_harms_nothing(core, make_plugin):
    core.install(good(make_plugin, "sw-good"), make_plugin("sw-bad", "import no_such_library"))
    plugins = core.plugins()
    assert "No module named 'no_such_library'" in plugins["sw-bad"]["error"]
    assert plugins["sw-good"]["error"] is None
    text = core.run("list-plugins").stdout
    assert "no_such_library" in text


def test_a_plugin_whose_hook_raises_half_way_leaves_nothing_behind(core, make_plugin):
    source = GOOD.format(module="sw_half") + "\n    @hookimpl\n    def register_methods(registry):\n        1 / 0\n"
    core.install(make_plugin("sw-half", source))
    listed = core.plugins()["sw-half"]
    assert "ZeroDivisionError" in listed["error"]
    assert listed["provides"] == []


def test_a_name_that_two_plugins_claim_is_an_error_that_names_both(core, make_plugin):
    core.install(good(make_plugin, "sw-one"), good(make_plugin, "sw-two"))
    listed = json.loads(core.run("list-plugins", "--json").stdout)
    (clash,) = listed["clashes"]
    assert clash["kind"] == "metric"
    assert clash["name"] == "mean"
    assert sorted(clash["distributions"]) == ["sw-one 0.1", "sw-two 0.1"]
    done = core.run("list-plugins")
    assert re.search(r"mean.*sw-one.*sw-two", " ".join((done.stdout + done.stderr).split()))


def test_asking_for_a_clashing_name_exits_2_and_names_both(core, make_plugin):
    method = """
        from splatwizard_core.api import hookimpl

        @hookimpl
        def register_methods(registry):
            registry.add("mine", "{module}:Mine", summary="none")
    """
    core.install(*(make_plugin(n, method.format(module=n.replace("-", "_"))) for n in ("sw-one", "sw-two")))
    done = core.run("schedule", "mine", check=False)
    assert done.returncode == 2
    assert "sw-one 0.1" in done.stderr
    assert "sw-two 0.1" in done.stderr
    assert "Traceback" not in done.stderr


def test_sw_plugins_restricts_what_loads(core, make_plugin):
    core.install(good(make_plugin, "sw-one"), good(make_plugin, "sw-two"))
    assert set(core.plugins(SW_PLUGINS="two")) == {"splatwizard-core", "sw-two"}
    assert set(core.plugins(SW_PLUGINS="sw-two")) == {"splatwizard-core", "sw-two"}
    assert set(core.plugins(SW_PLUGINS="")) == {"splatwizard-core"}


def test_sw_plugins_with_an_unknown_name_exits_2(core):
    done = core.run("list-plugins", check=False, SW_PLUGINS="nothing")
    assert done.returncode == 2
    assert "nothing" in done.stderr


def test_a_plugin_that_lacks_another_plugin_says_which(core, make_plugin):
    core.install(good(make_plugin, "sw-needy", requires=("sw-absent>=2",)))
    assert "pip install sw-absent" in core.plugins()["sw-needy"]["error"]


HELLO = """
    import sys

    import click
    from splatwizard_core.api import hookimpl

    @hookimpl{options}
    def {name}(registry):
        registry.add("hello", "sw_hello:hello", summary="says hello")

    @click.command()
    def hello():
        click.echo("hello from a plugin")
"""


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("register_commands", ""),
        ("anything", "(specname='register_commands')"),
        ("register_commands", "(tryfirst=True)"),
    ],
)
def test_a_plugin_can_add_a_command(core, make_plugin, name, options):
    core.install(make_plugin("sw-hello", HELLO.format(name=name, options=options)))
    assert core.run("hello").stdout == "hello from a plugin\n"
    assert re.search(r"hello +says hello", core.run("--help").stdout)


def test_an_unmarked_function_of_a_hooks_name_is_not_called(core, make_plugin):
    source = HELLO.format(name="register_commands", options="").replace("@hookimpl", "")
    core.install(make_plugin("sw-hello", source))
    assert core.run("hello", check=False).returncode == 2


def test_a_wrapper_around_the_hooks_of_others_runs(core, make_plugin):
    wrapper = """
        import sys
        from splatwizard_core.api import hookimpl

        @hookimpl(wrapper=True)
        def register_metrics(registry):
            before = len(registry)
            result = yield
            print(f"metrics: {before} and then {len(registry)}", file=sys.stderr)
            return result
    """
    core.install(good(make_plugin, "sw-good"), make_plugin("sw-wrapper", wrapper))
    done = core.run("list-plugins", "--json")
    assert re.search(r"metrics: 0 and then [1-9]", done.stderr)
    assert all(row["error"] is None for row in json.loads(done.stdout)["plugins"])


@pytest.mark.parametrize("half", ["1 / 0\n            yield", "yield\n            1 / 0"])
def test_a_wrapper_that_fails_is_broken_alone(core, make_plugin, half):
    wrapper = f"""
        from splatwizard_core.api import hookimpl

        @hookimpl(wrapper=True)
        def register_metrics(registry):
            {half}
    """
    core.install(good(make_plugin, "sw-good"), make_plugin("sw-wrapper", wrapper))
    listed = core.plugins()
    assert "ZeroDivisionError" in listed["sw-wrapper"]["error"]
    assert [e["name"] for e in listed["sw-good"]["provides"]] == ["mean"]


def test_a_misspelt_hook_is_broken_with_its_name(core, make_plugin):
    core.install(make_plugin("sw-hello", HELLO.format(name="register_comands", options="")))
    assert "register_comands" in core.plugins()["sw-hello"]["error"]


def test_core_and_one_plugin_with_its_library_work_alone(core, wheels):
    """The wheels hold everything: a codec round trip in an environment that never saw the source tree."""
    core.install(wheels["sw-codecs"], wheels["sw-gaussians"])
    plugins = core.plugins()
    assert set(plugins) == {"splatwizard-core", "sw-codecs", "sw-gaussians"}
    assert plugins["sw-codecs"]["error"] is None
    code = (
        "import numpy as np, splatwizard_core, sw_codecs\n"
        "from splatwizard_core.plugins import load_plugins\n"
        "codec = load_plugins().coders.load('octree')()\n"
        "points = codec.decode(codec.encode(np.array([[1, 2, 3], [4, 5, 6]]), 8))\n"
        "assert points.tolist() == [[1, 2, 3], [4, 5, 6]], points\n"
        "print(splatwizard_core.__file__)"
    )
    import subprocess

    done = subprocess.run([str(core.python), "-c", code], capture_output=True, text=True, cwd=core.prefix, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(core.prefix))
