"""Plugins that do what a plugin must not: the sources of distributions for tests/test_hostile_plugins.py."""

from __future__ import annotations

from strangers_site import Site

METRIC = """
@hookimpl
def register_metrics(registry):
    registry.add({name!r}, "{module}:value", summary="a value", {fields})

def value(render, truth):
    {body}
"""


def metric(name: object, module: str, body: str = "return 1.0", fields: str = "direction='higher'") -> str:
    return METRIC.format(name=name, module=module, body=body, fields=fields)


def hook(name: str, *lines: str) -> str:
    return "\n".join([f"@hookimpl\ndef {name}(registry):", *(f"    {line}" for line in lines)]) + "\n"


BROKEN = {
    "sw-exits": ("import sys\nsys.exit('needs a licence')\n", "SystemExit: needs a licence"),
    "sw-raises": ("import no_such_library\n", "No module named 'no_such_library'"),
    "sw-hook-raises": (metric("half", "sw_hook_raises") + hook("register_methods", "1 / 0"), "ZeroDivisionError"),
    "sw-hook-exits": (hook("register_commands", "raise SystemExit(0)"), "register_commands: SystemExit: 0"),
    "sw-wrong-hook": (
        metric("early", "sw_wrong_hook") + hook("register_methods", "pass").replace("registry", "wrong"),
        "wrong",
    ),
    "sw-hides-reason": ("class E(Exception):\n    def __str__(self): return 1\nraise E\n", "E"),
}
"""Distribution -> its plugin module, and what the line about it says."""

REFUSED = {
    "sw-claims-psnr": (metric("psnr", "sw_claims_psnr"), "metric 'psnr'", "a name of splatwizard-core"),
    "sw-claims-3dgs": (hook("register_methods", "registry.add('3dgs', 'm:C', summary='')"), "method '3dgs'", "sw-3dgs"),
    "sw-claims-colmap": (
        hook("register_datasets", "registry.add('colmap', 'm:C', summary='')"), "dataset 'colmap'", "sw-datasets",
    ),
    "sw-claims-ply": (
        hook("register_exporters", "registry.add('ply', 'm:f', summary='', suffix='.ply')"), "exporter 'ply'",
        "sw-gaussians",
    ),
    "sw-claims-run": (hook("register_commands", "registry.add('run', 'm:f', summary='')"), "command 'run'", "core"),
    "sw-comma": (metric("a,b", "sw_comma"), "metric 'a,b'", "is no name"),
    "sw-space": (metric("a b", "sw_space"), "metric 'a b'", "is no name"),
    "sw-number": (metric(7, "sw_number"), "metric '7'", "is no name"),
    "sw-up": (hook("register_methods", "registry.add('../up', 'm:C', summary='')"), "method '../up'", "is no name"),
    "sw-native-list": (
        hook("register_rasterizers", "registry.add('metal', 'm:C', summary='', native=[1])"), "rasterizer 'metal'",
        "native=[1]",
    ),
    "sw-object": (
        hook("register_coders", "registry.add('odd', 'm:C', summary='', codes=object)"), "coder 'odd'",
        "no plain value",
    ),
    "sw-position": (
        hook("register_commands", "registry.add('odd', 'm:f', summary='', position='first')"), "command 'odd'",
        "position='first'",
    ),
    "sw-direction": (metric("up", "sw_direction", fields="direction='up'"), "metric 'up'", "direction='up'"),
}  # fmt: skip
"""Distribution -> its plugin module, the entry that is refused, and why."""

METRICS = {
    "sw-metric-raises": ("raise OSError('no disk')", "OSError: no disk"),
    "sw-metric-exits": ("raise SystemExit(0)", "SystemExit: 0"),
    "sw-metric-vector": ("return render.mean((1, 2))", "scalars"),
    "sw-metric-changes": ("render.zero_(); truth.zero_(); return 1.0", "changes the images"),
    "sw-metric-user-error": (
        "from splatwizard_core.api import UserInputError; raise UserInputError('give up')", "UserInputError: give up",
    ),
}  # fmt: skip
"""Distribution -> body of a metric, and why it has no value."""

DETECTS = {
    "sw-detect-raises": ("raise OSError('no disk')", "OSError: no disk"),
    "sw-detect-exits": ("raise SystemExit(0)", "SystemExit: 0"),
    "sw-detect-five": ("return 5.0", "detect() gave 5.0"),
}
DATASET = """
@hookimpl
def register_datasets(registry):
    registry.add("{name}", "{module}:Family", summary="a family")

class Family:
    def detect(self, path):
        {body}
"""

NOISY = """
print("NOISE at import")

@hookimpl
def register_metrics(registry):
    print("NOISE of a hook")
    registry.add("noisy", "sw_noisy_metric:value", summary="prints", direction="higher")

@hookimpl
def describe_scene(scene):
    print("NOISE about a scene")

@hookimpl
def run_finished(runs):
    print("NOISE after a run")
"""
NOISY_METRIC = """
print("NOISE of a target")

def value(render, truth):
    print("NOISE of a value")
    return 1.0
"""

HOOKS = """
@hookimpl
def run_started(training):
    return 5

@hookimpl
def run_finished(runs):
    raise SystemExit(0)

@hookimpl
def describe_scene(scene):
    return 5
"""

RASTERIZERS = """
@hookimpl
def register_rasterizers(registry):
    features = ["BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COLORS_ND", "SPLIT_SH", "INDEXED_SH"]
    known = dict(devices=["cpu", "cuda"], features=features)
    registry.add("boaster", "sw_lightning:Boaster", summary="draws black pictures", speed=9999, **known)
    registry.add("lightning", "sw_lightning:Raises", summary="fast, it says", speed=999, **known)
    registry.add("exits", "sw_lightning:Exits", summary="exits", speed=998, native="sw_no_kernels:MODULE", **known)
    registry.add("lies", "sw_lightning:Lies", summary="another name", speed=998, **known)
    registry.add("unreadable", "sw_lightning:Lies", summary="no speed", speed="fast", devices=5)

def Boaster():
    from splatwizard_core.api import RasterizerInfo
    from sw_reference.rasterizer import ReferenceRasterizer

    class Black(ReferenceRasterizer):
        info = RasterizerInfo.declared(register_rasterizers, "boaster")
        def render(self, g, cam, opt):
            found = super().render(g, cam, opt)
            found.image = found.image * 0
            return found

    return Black()

class Raises:
    def __init__(self):
        raise RuntimeError("no such GPU")

class Exits:
    def __init__(self):
        raise SystemExit(0)

class Lies:
    class info:
        name = "standard"
"""

METHODS = """
@hookimpl
def register_methods(registry):
    for name in ("misnamed", "task-raises", "task-exits", "stages-exits", "stages-raises", "import-exits"):
        target = "sw_methods_exits:C" if name == "import-exits" else "sw_methods_bad:" + name.replace("-", "_")
        registry.add(name, target, summary="a method")

@hookimpl
def register_exporters(registry):
    registry.add("export-raises", "sw_methods_bad:export_raises", summary="", suffix=".bad")
    registry.add("zz-ply", "sw_methods_bad:export_raises", summary="", suffix=".ply")
    registry.add("export-exits", "sw_methods_bad:export_exits", summary="", suffix=".out")
    registry.add("export-nothing", "sw_methods_bad:export_nothing", summary="", suffix=".void")

@hookimpl
def register_pruners(registry):
    registry.add("prune-raises", "sw_methods_bad:PruneRaises", summary="")
    registry.add("prune-exits", "sw_methods_bad:PruneExits", summary="")

@hookimpl
def register_commands(registry):
    registry.add("exits-three", "sw_methods_bad:exits_three", summary="its own status")
    registry.add("command-breaks", "sw_methods_exits:C", summary="its module exits")
"""
METHODS_BAD = """
import sys
import click
from splatwizard_core.api import Method, create_method

def raises():
    raise OSError("no disk")

def exits():
    sys.exit(0)

class Borrowing(Method):
    task = None

    def create_model(self, scene, generator):
        return create_method(self.plugins, "3dgs").create_model(scene, generator)

    def stages(self):
        (stage,) = create_method(self.plugins, "3dgs", {"iterations": 2}).stages()
        stage.register_pre_task = lambda scheduler, ppl, opt: scheduler.register_task(1, self.task, name="bad task")
        return [stage]

class misnamed(Method):
    name = "3dgs"

class task_raises(Borrowing):
    name, task = "task-raises", staticmethod(raises)

class task_exits(Borrowing):
    name, task = "task-exits", staticmethod(exits)

class stages_exits(Method):
    name = "stages-exits"
    def stages(self):
        exits()

class stages_raises(Method):
    name = "stages-raises"
    def stages(self):
        raises()

def export_raises(model, path):
    raise ValueError("no such vertex")

def export_exits(model, path):
    exits()

def export_nothing(model, path):
    pass

class PruneRaises:
    uses_statistics = False
    def score(self, model, cameras, rasterizer, background=None):
        raises()

class PruneExits(PruneRaises):
    def score(self, model, cameras, rasterizer, background=None):
        exits()

@click.command()
def exits_three():
    sys.exit(3)
"""


def move_in(site: Site) -> None:
    """Install them all, and sw-good, which is as it should be."""
    for name, (source, *_) in {**BROKEN, **REFUSED}.items():
        site.install(name, source)
    for name, (body, _) in METRICS.items():
        module = name.replace("-", "_")
        site.install(name, metric(name.removeprefix("sw-"), module, body))
    for name, (body, _) in DETECTS.items():
        site.install(name, DATASET.format(name=name.removeprefix("sw-"), module=name.replace("-", "_"), body=body))
    site.install("sw-noisy", NOISY, sw_noisy_metric=NOISY_METRIC)
    site.install("sw-hooks", HOOKS)
    site.install("sw-lightning", RASTERIZERS, sw_no_kernels="raise SystemExit(0)")
    site.install("sw-methods", METHODS, sw_methods_bad=METHODS_BAD, sw_methods_exits="raise SystemExit('no licence')")
    site.install("sw-core-thief", metric("thief", "sw_core_thief"), key="core")
    site.install("sw-key-thief", metric("thief2", "sw_key_thief"), key="3dgs")
    for name in ("sw-twin-b", "sw-twin-a"):
        site.install(name, metric(name.removeprefix("sw-"), name.replace("-", "_")), key="twin")
    site.install("sw-future", metric("future", "sw_future"), requires=["splatwizard-core>=9"])
    site.install("sw-needy", metric("needy", "sw_needy"), requires=["no-such-distribution-here>=2"])
    site.install("sw-nameless", metric("nameless", "sw_nameless"), key="sw-3dgs", metadata=b"")
    site.install("sw-binary", metric("binary", "sw_binary"), metadata=b"Name: \xff\xfe\n")
    site.install("sw-good", metric("good", "sw_good"))
