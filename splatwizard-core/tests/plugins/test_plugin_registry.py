"""A plugin that fails harms nothing else, whatever it had added or claimed before."""

import importlib.metadata
import sys
import types

import pytest

import splatwizard_core.cli.main
from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import Entry, PluginManager, hookimpl


@pytest.fixture
def manager_of(monkeypatch):
    """manager_of(name=function that fills the metric registry, ...) -> a manager of these plugins."""

    def make(**hooks) -> PluginManager:
        for name, hook in hooks.items():
            module = types.ModuleType(f"fake_{name}")
            module.register_metrics = hookimpl(hook)
            monkeypatch.setitem(sys.modules, module.__name__, module)
        return PluginManager(importlib.metadata.EntryPoint(n, f"fake_{n}", "splatwizard") for n in hooks)

    return make


def adds(name: str):
    def register_metrics(registry):
        registry.add(name, "math:fsum", summary="a sum")

    return register_metrics


def adds_and_fails(name: str):
    def register_metrics(registry):
        registry.add(name, "math:fsum", summary="a sum")
        raise OSError("no disk")

    return register_metrics


def test_a_failed_plugin_gives_back_the_name_that_it_claimed(manager_of):
    plugins = manager_of(good=adds("mean"), zz=adds_and_fails("mean"))
    assert [p.key for p in plugins.broken] == ["zz"]
    assert plugins.metrics.clashes == {}
    assert plugins.metrics.entry("mean").distribution == "good"


def test_two_that_claim_a_name_still_clash_when_a_third_failed(manager_of):
    plugins = manager_of(a=adds("mean"), b=adds("mean"), c=adds_and_fails("mean"))
    assert [e.distribution for e in plugins.metrics.clashes["mean"]] == ["a", "b"]
    with pytest.raises(PluginError, match=r"claimed by a .* and b"):
        plugins.metrics.entry("mean")


def test_a_plugin_that_exits_when_imported_is_listed_as_broken(manager_of, tmp_path, monkeypatch):
    (tmp_path / "fake_quitter.py").write_text("raise SystemExit('needs a licence')")
    monkeypatch.syspath_prepend(tmp_path)
    entry_points = [importlib.metadata.EntryPoint("quitter", "fake_quitter", "splatwizard")]
    (info,) = PluginManager(entry_points).plugins
    assert info.error == "SystemExit: needs a licence"


@pytest.fixture
def installed(tmp_path):
    """Entry points of two installed distributions, as importlib finds them."""
    for name in ("sw-3dgs", "Sw_Other"):
        info = tmp_path / f"{name.replace('-', '_')}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        (info / "entry_points.txt").write_text(f"[splatwizard]\n{name[3:].lower()} = math\n")
    found = [e for d in importlib.metadata.distributions(path=[str(tmp_path)]) for e in d.entry_points]
    assert sorted(e.name for e in found) == ["3dgs", "other"]
    return found


@pytest.mark.parametrize("name", ["3dgs", "sw-3dgs", "SW_3dgs"])
def test_a_plugin_is_chosen_by_its_entry_point_or_its_distribution(installed, name):
    assert [p.distribution for p in PluginManager(installed, only={name}).plugins] == ["sw-3dgs"]
    assert [p.key for p in PluginManager(installed, only={name, "sw-other"}).plugins] == ["3dgs", "other"]
    assert PluginManager(installed, only=set()).plugins == []


def test_a_plugin_that_is_chosen_but_not_installed_is_an_error_that_names_those_that_are(installed):
    with pytest.raises(PluginError, match=r"SW_PLUGINS names 'sw-4dgs', .*there are: 3dgs, other"):
        PluginManager(installed, only={"sw-4dgs", "sw-3dgs"})


def test_what_a_block_loads_is_recorded_by_name_and_only_there(manager_of):
    manager = manager_of(one=adds("sum"), other=adds("total"))
    manager.metrics.load("sum")
    with manager.recording() as outer:
        manager.metrics.load("total")
        with manager.recording() as inner:
            manager.metrics.load("sum")
            manager.metrics.load("sum")
    manager.metrics.load("total")
    assert [(e.kind, e.name) for e in outer] == [("metric", "total"), ("metric", "sum"), ("metric", "sum")]
    assert [e.name for e in inner] == ["sum", "sum"]


def test_a_name_that_is_not_there_is_a_fact_of_the_error(manager_of):
    with pytest.raises(PluginError) as caught:
        manager_of(one=adds("sum")).metrics.load("product")
    assert (caught.value.kind, caught.value.name) == ("metric", "product")


# ------------------------------------------------------------------------------------------ ours and strangers


@pytest.fixture
def distributions(tmp_path, monkeypatch):
    """distributions(("sw-hac", "hac", hook), ...): entry points of installed distributions with these metric hooks."""

    def install(*plugins):
        for name, key, hook in plugins:
            module = types.ModuleType(f"fake_{name.replace('-', '_')}")
            module.register_metrics = hook if hasattr(hook, "splatwizard_impl") else hookimpl(hook)
            monkeypatch.setitem(sys.modules, module.__name__, module)
            info = tmp_path / f"{name.replace('-', '_')}-0.1.dist-info"
            info.mkdir()
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
            (info / "entry_points.txt").write_text(f"[splatwizard]\n{key} = {module.__name__}\n")
        return [e for d in importlib.metadata.distributions(path=[str(tmp_path)]) for e in d.entry_points]

    return install


@pytest.mark.parametrize("order", [1, -1])
def test_a_name_that_one_of_ours_adds_is_taken_from_strangers_whoever_comes_first(distributions, order):
    found = distributions(*((n, n[3:], adds("new")) for n in ("sw-hac", "sw-their-a", "sw-their-b")))[::order]
    plugins = PluginManager(found)
    assert plugins.metrics.entry("new").distribution == "sw-hac"
    assert plugins.metrics.clashes == {}
    told = {entry.distribution: why for entry, why in plugins.metrics.refused}
    assert set(told) == {"sw-their-a", "sw-their-b"}
    assert all("a name of sw-hac" in why for why in told.values())


def test_a_name_of_ours_is_refused_though_its_package_is_left_out(distributions):
    plugins = PluginManager(distributions(("sw-their", "their", adds("lpips_vgg"))))
    ((entry, why),) = plugins.refused_of(plugins.plugins[0])
    assert (entry.name, entry.foreign) == ("lpips_vgg", True)
    assert "a name of sw-metrics" in why
    assert "lpips_vgg" not in plugins.metrics


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_strangers_with_one_entry_point_neither_loads_whatever_the_order(distributions, order):
    found = distributions(("sw-a", "same", adds("a")), ("sw-b", "same", adds("b")), ("sw-c", "c", adds("c")))[::order]
    plugins = PluginManager(found)
    assert [p.distribution for p in plugins.broken] == ["sw-a", "sw-b"]
    assert plugins.metrics.names == ["c"]
    assert PluginManager(found, only={"sw-a"}).metrics.names == ["a"]


def test_what_a_wrapper_adds_after_the_others_is_its_own(distributions):
    @hookimpl(wrapper=True)
    def register_metrics(registry):
        yield
        registry.add("late", "math:fsum", summary="a sum")

    plugins = PluginManager(distributions(("sw-hac", "hac", adds("new")), ("sw-their", "their", register_metrics)))
    assert plugins.metrics.entry("late").distribution == "sw-their"


def test_what_a_hook_prints_is_no_output(manager_of, capsys):
    def register_metrics(registry):
        print("loud")

    manager_of(loud=register_metrics)
    assert capsys.readouterr() == ("", "loud\n")


@pytest.mark.parametrize(
    ("name", "declared", "said"),
    [("a/b", {}, "no name"), ("", {}, "no name"), ("-x", {}, "no name"), (None, {}, "no name"),
     ("x", {"position": float("nan")}, "no plain value"), ("x", {"label": 3}, "label=3; it must be a text"),
     ("x", {"presets": "quick"}, "a list of texts"), ("x", {"native": "no target"}, "module:attribute")],
)  # fmt: skip
def test_an_entry_that_is_not_legal_is_refused_alone(manager_of, name, declared, said):
    def register_metrics(registry):
        registry.add(name, "math:fsum", summary="a sum", **declared)
        registry.add("fine", "math:fsum", summary="a sum")

    plugins = manager_of(one=register_metrics)
    assert plugins.broken == []
    assert plugins.metrics.names == ["fine"]
    ((_, why),) = plugins.metrics.refused
    assert said in why


def test_a_class_with_another_name_than_its_method_cannot_be_loaded(monkeypatch):
    module = types.ModuleType("fake_methods")
    module.Mine = type("Mine", (), {"name": "mine"})
    monkeypatch.setitem(sys.modules, "fake_methods", module)
    assert Entry("method", "mine", "fake_methods:Mine", "").load() is module.Mine
    with pytest.raises(PluginError, match="method 'yours' of sw-x 1 is called 'mine' by its class"):
        Entry("method", "yours", "fake_methods:Mine", "", distribution="sw-x", version="1").load()


def test_a_core_whose_requirements_are_not_met_says_so_where_no_command_is_known(tmp_path, caplog, monkeypatch):
    info = tmp_path / "splatwizard_core-0.1.dist-info"
    info.mkdir()
    metadata = "Metadata-Version: 2.1\nName: splatwizard-core\nVersion: 0.1\nRequires-Dist: pluggy>=999\n"
    (info / "METADATA").write_text(metadata)
    (info / "entry_points.txt").write_text("[splatwizard]\ncore = splatwizard_core.builtin\n")
    found = [e for d in importlib.metadata.distributions(path=[str(tmp_path)]) for e in d.entry_points]
    plugins = PluginManager(found)
    monkeypatch.setattr(splatwizard_core.cli.main, "load_plugins", lambda: plugins)
    assert splatwizard_core.cli.main.main(["run"]) == 2
    (said,) = caplog.messages
    assert said.startswith("splatwizard-core 0.1 cannot be loaded: needs pluggy>=999, but ")
    assert said.endswith("pip install 'pluggy>=999'")
