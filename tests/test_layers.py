"""Who may import whom: knowledge flows downward, through two faces; only what extends a method imports it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from import_graph import (
    CORE,
    NATIVE,
    PACKAGES,
    STRANGERS,
    Closure,
    circles,
    declared_dependencies,
    files_of,
    imported,
    lines_of,
    longest_chain,
    module_files,
    module_graph,
    reached,
)

import splatwizard_native
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours

BELOW_ALL = {"errors", "streams", "base"}
"""Modules and a room of plain tools that know no room."""
BELOW_RUNS = {"training", "coding", "evaluation", "rendering", "gaussians", "scene", "plugins"}
ROOMS = {
    "plugins": set(),
    "scene": {"plugins"},
    "gaussians": {"scene"},
    "rendering": {"gaussians", "scene", "plugins"},
    "training": {"rendering", "gaussians", "scene", "plugins"},
    "coding": {"gaussians", "scene", "plugins"},
    "evaluation": {"rendering", "gaussians", "scene", "plugins"},
    "method": {"training", "coding", "gaussians", "scene", "plugins"},
    "runs": {"method", *BELOW_RUNS},
    "cli": {"runs", "method", *BELOW_RUNS},
    "steps": {"cli", "runs", "evaluation", "training", "api", "tooling"},
    "builtin": {"plugins"},
    "__main__": {"cli"},
    # The faces import what they lend when somebody asks for it.
    "api": set(),
    "tooling": set(),
    **{module: set() for module in BELOW_ALL},
}
"""Room of the core -> the rooms that it may import when it runs. What only a type checker reads is free."""

LIBRARIES = {
    "sw_rasterizers", "sw_codecs", "sw_gaussians", "sw_anchors", "sw_reference", "sw_interchange", "sw_view",
    "sw_report", "sw_parallel",
}  # fmt: skip
"""Packages that others may import when they declare them; of sw_report the format of published figures and BD-rates."""
EXTENDS = {"sw_hac_plus": "sw_hac"}
"""Method -> the method that it builds on, and so imports."""
ABOUT_RUNS = {
    "sw_bench", "sw_compress", "sw_datasets", "sw_doctor", "sw_geometry", "sw_interchange", "sw_kit", "sw_lod",
    "sw_metrics", "sw_parallel", "sw_report", "sw_view",
}  # fmt: skip
"""Packages that may use `tooling` besides `api`."""


def room_of(path: Path) -> str:
    return path.relative_to(CORE).parts[0].removesuffix(".py")


def test_every_room_is_in_the_table():
    assert {room_of(p) for p in files_of(CORE)} - {"__init__"} == set(ROOMS)


def lines_in(paths: Iterable[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


@pytest.mark.parametrize("room", sorted(path.name for path in CORE.iterdir() if (path / "__init__.py").is_file()))
def test_a_room_is_small_enough_to_follow(room):
    lines = lines_in(files_of(CORE / room))
    assert lines <= 3_000, f"{room} has {lines:,} lines"


def test_core_and_native_together_stay_small():
    lines = lines_in(files_of(CORE)) + lines_in(files_of(NATIVE))
    assert lines < 16_835, f"core and native have {lines:,} lines"


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_only_what_lies_below(room):
    upward = []
    for path in files_of(CORE / room) or [CORE / f"{room}.py"]:
        for name in imported(path):
            package, _, rest = name.partition(".")
            allowed = {room, "__version__", ""} | BELOW_ALL | ROOMS[room]
            if package == "splatwizard_core" and rest.partition(".")[0] not in allowed:
                upward.append(f"{path.relative_to(CORE)} imports {name}")
    assert upward == []


def test_the_table_has_no_circle():
    assert circles({room: frozenset(uses) for room, uses in ROOMS.items()}) == []


def test_no_modules_import_each_other():
    assert circles(module_graph()) == []


def test_the_longest_chain_of_imports_stays_short():
    # Plain tools are left out: whoever imports their names need not know their inside.
    inside = {each for each in module_graph() if each.startswith(("splatwizard_native", "splatwizard_core.base."))}
    chain = longest_chain({module: uses - inside for module, uses in module_graph().items()})
    assert len(chain) <= 17, " -> ".join(chain)


def test_the_base_imports_nothing_of_ours():
    ours = {m for p in files_of(NATIVE) for m in imported(p) if m.startswith(("splatwizard_", "sw_"))}
    assert {name.partition(".")[0] for name in ours} == {"splatwizard_native"}
    assert declared_dependencies(NATIVE) == {"torch", "numpy", "filelock"}


# What a reader must follow

CLOSURES = {
    "sw_hac_plus.method": (60, 6_000),
    "sw_cat_3dgs.method": (60, 6_000),
    "sw_wisp.method": (60, 7_490),
}
"""Method -> the most modules and lines of its closure, where not (45, 4,500)."""
CLOSURE = (45, 4_500)


def method_modules() -> list[str]:
    """Modules of the methods of ours."""
    methods = load_plugins().registries["method"]
    return sorted({entry.target.partition(":")[0] for entry in methods if is_ours(entry.distribution)})


@pytest.mark.parametrize("module", method_modules())
def test_a_method_can_be_read(module):
    found, limit = Closure.of(module), CLOSURES.get(module, CLOSURE)
    print(f"{module}: {found}")
    modules, lines = limit
    assert found.modules <= modules, f"{module} has {found}, at most {modules} modules"
    assert found.lines <= lines, f"{module} has {found}, at most {lines:,} lines"


FAMILIES = {"sw_hac_plus": "sw_hac"}
"""Package -> the one whose family it belongs to; every other package is a family of its own."""
SHELVES = {"sw_rasterizers", "sw_codecs", "sw_gaussians", "sw_anchors", "sw_reference"}
"""Libraries for methods: what stands there serves two families, or can be chosen by name."""
FOR_ONE = {
    "sw_gaussians.baking": "makes explicit Gaussians of a model for sw-view, and knows the parts of GaussianModel",
    "sw_gaussians.bake_refining": "trains on pictures that sw-view gives it, with the stage of sw-gaussians",
    "sw_gaussians.ring_cameras": "two more recipes beside `made_up_cameras`, by which the MPEG protocol draws",
    "sw_gaussians.merging": "moments of Gaussians, for any simplification: levels of detail are the first",
    "sw_gaussians.merge_costs": "the price of a merge, beside it",
    "sw_gaussians.simplifying": "a model with fewer Gaussians, beside the pruners, for compression too",
}
"""Module of a library that one family alone reaches -> why it is there; at most ten."""


def test_a_library_holds_what_two_families_use():
    targets = {
        target.partition(":")[0]
        for registry in load_plugins().registries.values()
        for entry in registry
        if is_ours(entry.distribution)
        for target in (entry.target, *as_list(entry.declared.get("native")))
    }
    named = reached(target for target in targets if target.partition(".")[0] in SHELVES)
    users: dict[str, set[str]] = {}
    for module in module_files():
        package = module.partition(".")[0]
        if package.startswith("sw_") and package not in SHELVES:
            users.setdefault(FAMILIES.get(package, package), set()).add(module)
    reach = {family: reached(modules) for family, modules in users.items()}
    lonely = {}
    for module in module_files():
        parts = module.split(".")
        offered = parts[0] in SHELVES and parts[-1] != "plugin" and "testing" not in parts and lines_of(module) > 5
        offered = offered and not module_files()[module].read_text(encoding="utf-8").startswith('"""Old import path')
        families = [family for family, modules in reach.items() if module in modules]
        if offered and len(families) < 2 and module not in named:
            lonely[module] = f"{lines_of(module)} lines, for {', '.join(families) or 'nobody'}"
    assert len(FOR_ONE) <= 10
    assert not set(lonely) - set(FOR_ONE), "\n".join(f"{module}: {what}" for module, what in sorted(lonely.items()))


def as_list(given: str | list[str] | None) -> list[str]:
    return [given] if isinstance(given, str) else given or []


def room(module: str) -> str:
    """The room of the core that a module lies in, or its package."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == CORE.name else parts[0]


CIRCLES_OF_TYPES = [
    {"splatwizard_core.method", "splatwizard_core.plugins", "splatwizard_core.plugins.hookspecs",
     "splatwizard_core.plugins.manager", "splatwizard_core.plugins.origins", "splatwizard_core.runs.observers"},
    {"splatwizard_native", "splatwizard_native.fused.adam",
     "splatwizard_native.fused.in_backward", "splatwizard_native.fused.native", "splatwizard_native.fused.photometric"},
    {"sw_interchange.frames", "sw_interchange.scene"},
    {"sw_interchange.spz", "sw_interchange.spz_fields"},
]  # fmt: skip
"""Modules that import each other once what only a type checker reads is counted: they may shrink, none may come."""


def test_no_modules_name_each_other_outside_a_room_of_the_core():
    for circle in circles(module_graph(types=True)):
        inside_a_room = len({room(module) for module in circle}) == 1 and circle[0].startswith(CORE.name)
        assert inside_a_room or any(set(circle) <= known for known in CIRCLES_OF_TYPES), f"a circle: {circle}"


@pytest.mark.parametrize("package", [CORE, *PACKAGES, *STRANGERS], ids=lambda p: p.name)
def test_the_base_is_imported_by_its_public_names_where_it_is_declared(package):
    used = {m for p in files_of(package) for m in imported(p) if m.startswith("splatwizard_native")}
    assert used <= {f"splatwizard_native.{name}" for name in splatwizard_native.__all__}
    assert ("splatwizard-native" in declared_dependencies(package)) == bool(used)


def test_the_core_imports_no_plugin():
    found = [(p.name, m) for p in files_of(CORE) for m in imported(p) if m.startswith("sw_")]
    assert found == []


@pytest.mark.parametrize("package", [*PACKAGES, *STRANGERS], ids=lambda p: p.name)
def test_a_package_imports_the_core_through_its_faces(package):
    faces = {"api", "tooling"} if package.name in ABOUT_RUNS else {"api"}
    inside = [
        f"{p.relative_to(package)} imports {m}"
        for p in files_of(package)
        for m in imported(p)
        if m.startswith("splatwizard_core") and m.split(".")[1] not in faces
    ]
    assert inside == []


@pytest.mark.parametrize("package", [*PACKAGES, *STRANGERS], ids=lambda p: p.name)
def test_a_package_imports_declared_libraries_alone(package):
    others = {m.split(".")[0] for p in files_of(package) for m in imported(p) if m.startswith("sw_")} - {package.name}
    assert others <= LIBRARIES | {EXTENDS.get(package.name)}
    assert {name.replace("_", "-") for name in others} <= declared_dependencies(package)


def test_the_dependencies_of_packages_form_no_circle():
    ours = {package.name.replace("_", "-"): package for package in PACKAGES}
    graph = {name: frozenset(declared_dependencies(package) & set(ours)) for name, package in ours.items()}
    assert circles(graph) == []
    assert any(graph.values()), "no dependency was found: the test looks in the wrong place"


def test_imports_are_found_wherever_they_stand(tmp_path):
    """The finder itself: in functions, in `else` branches, but not for type checkers alone."""
    source = """
        import a.b, c
        from d.e import f
        def function():
            from g import h
        if TYPE_CHECKING:
            import no
        else:
            import i
        try:
            import j
        except ImportError:
            import k
    """
    path = tmp_path / "module.py"
    path.write_text("if True:\n" + source)
    assert list(imported(path)) == ["a.b", "c", "d.e.f", "g.h", "i", "j", "k"]
    assert set(imported(path, types=True)) == {*imported(path), "no"}


def test_circles_and_chains_are_found():
    graph = {"a": frozenset("b"), "b": frozenset("ca"), "c": frozenset(), "d": frozenset("d"), "e": frozenset("ac")}
    assert circles(graph) == [["a", "b"]]
    assert longest_chain({"a": frozenset("b"), "b": frozenset("c"), "c": frozenset(), "d": frozenset("c")}) == list(
        "abc"
    )


@pytest.mark.parametrize("arguments", [[], ["--help"], ["list-plugins"]], ids=["import", "help", "list-plugins"])
def test_what_must_be_quick_imports_no_torch(arguments):
    program = f"""
import sys
import splatwizard_core, splatwizard_core.api, splatwizard_core.tooling

status = 0
if {arguments}:
    from splatwizard_core.cli.main import main
    status = main({arguments})
print("torch" in sys.modules, file=sys.stderr)
sys.exit(status)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.split()[-1] == "False"
    assert bool(done.stdout) == bool(arguments)
