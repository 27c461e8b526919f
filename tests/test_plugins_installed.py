"""How plugins behave as really installed distributions: broken, clashing, incomplete.

Pip installs one of each kind into an environment of its own; the others lie in a folder on the path.
"""

from __future__ import annotations

import json
import re

import pytest
from fresh_environments import FreshEnvironment
from strangers_site import Listed, Site

GOOD = """
    from splatwizard_core.api import hookimpl

    @hookimpl
    def register_metrics(registry):
        registry.add("mean", "{module}:mean", summary="mean of the render", direction="higher")

    def mean(render, truth):
        return float(render.mean())
"""


def good(module: str) -> str:
    return GOOD.format(module=module)


def test_a_plugin_is_listed_with_what_it_provides(core, make_plugin):
    core.pip_install(make_plugin("sw-good", good("sw_good"), version="1.2"))
    listed = core.plugins()["sw-good"]
    assert listed["version"] == "1.2"
    assert listed["error"] is None
    assert [(e["kind"], e["name"]) for e in listed["provides"]] == [("metric", "mean")]


def test_core_and_one_plugin_with_its_library_work_alone(core: FreshEnvironment, wheels):
    """The wheels hold everything: a codec round trip in an environment that never saw the source tree."""
    core.install(wheels["sw-codecs"], wheels["sw-gaussians"])
    code = (
        "import numpy as np, splatwizard_core, sw_codecs\n"
        "from splatwizard_core.plugins import load_plugins\n"
        "plugins = load_plugins()\n"
        "found = {info.distribution: info.error for info in plugins.plugins}\n"
        "assert set(found) == {'splatwizard-core', 'sw-codecs', 'sw-gaussians'}, found\n"
        "assert found['sw-codecs'] is None, found\n"
        "codec = plugins.coders.load('octree')()\n"
        "points = codec.decode(codec.encode(np.array([[1, 2, 3], [4, 5, 6]]), 8))\n"
        "assert points.tolist() == [[1, 2, 3], [4, 5, 6]], points\n"
        "print(splatwizard_core.__file__)"
    )
    assert core.python_c(code).startswith(str(core.prefix))


def test_a_name_that_two_plugins_claim_is_an_error_that_names_both(tmp_path):
    site = Site(tmp_path)
    method = """
        @hookimpl
        def register_methods(registry):
            registry.add("mine", "{module}:Mine", summary="none")
    """
    for name in ("sw_one", "sw_two"):
        site.install(name.replace("_", "-"), good(name) + method.format(module=name).replace("\n    ", "\n"))
    clashes = site.listed().content["clashes"]
    assert [(clash["kind"], clash["name"]) for clash in clashes] == [("method", "mine"), ("metric", "mean")]
    assert all(sorted(clash["distributions"]) == ["sw-one 0.1", "sw-two 0.1"] for clash in clashes)
    listed, asked = site.sw_each([["list-plugins"], ["schedule", "mine"]])
    assert re.search(r"mean.*sw-one.*sw-two", " ".join((listed.stdout + listed.stderr).split()))
    assert asked.status == 2
    assert "sw-one 0.1" in asked.stderr
    assert "sw-two 0.1" in asked.stderr


HELLO = """
import click

@hookimpl{options}
def {hook}(registry):
    registry.add("{name}", "{module}:hello", summary="says hello")

@click.command()
def hello():
    click.echo("hello from a plugin")
"""
HOOKS = {
    "plain": ("", "register_commands"),
    "specname": ("(specname='register_commands')", "anything"),
    "first": ("(tryfirst=True)", "register_commands"),
}


def test_a_plugin_can_add_a_command_by_a_marked_function_alone(tmp_path):
    site = Site(tmp_path)
    for name, (options, hook) in HOOKS.items():
        site.install(f"sw-{name}", HELLO.format(options=options, hook=hook, name=name, module=f"sw_{name}"))
    source = HELLO.replace("@hookimpl", "").format(options="", hook="register_commands", name="unmarked", module="-")
    site.install("sw-unmarked", source)
    site.install("sw-misspelt", HELLO.format(options="", hook="register_comands", name="misspelt", module="-"))
    words = [["--help"], *([name] for name in HOOKS), ["unmarked"], ["misspelt"]]
    shown, *said, unmarked, misspelt = site.sw_each(words)
    for name, done in zip(HOOKS, said, strict=True):
        assert done.stdout == "hello from a plugin\n"
        assert re.search(rf"{name} +says hello", shown.stdout)
    assert (unmarked.status, misspelt.status) == (2, 2)
    assert "register_comands" in site.listed().of("sw-misspelt")["error"]


WRAPPER = """
import sys

@hookimpl(wrapper=True)
def register_metrics(registry):
    {before}
    before = len(registry)
    result = yield
    print(f"metrics: {{before}} and then {{len(registry)}}", file=sys.stderr)
    {after}
    return result
"""


@pytest.mark.parametrize(("before", "after"), [("pass", "pass"), ("1 / 0", "pass"), ("pass", "1 / 0")])
def test_a_wrapper_around_the_hooks_of_others_runs_and_if_it_fails_is_broken_alone(tmp_path, before, after):
    site = Site(tmp_path)
    site.install("sw-good", good("sw_good"))
    site.install("sw-wrapper", WRAPPER.format(before=before, after=after))
    done = site.sw("list-plugins", "--json", SW_PLUGINS="good,wrapper")
    listed = Listed(json.loads(done.stdout))
    assert [e["name"] for e in listed.of("sw-good")["provides"]] == ["mean"]
    if before == after:
        assert re.search(r"metrics: 0 and then [1-9]", done.stderr)
        assert all(row["error"] is None for row in listed.content["plugins"])
    else:
        assert "ZeroDivisionError" in listed.of("sw-wrapper")["error"]
