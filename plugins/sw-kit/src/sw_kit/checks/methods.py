"""Checks of a method's declarations: name, presets, rate points, hyper-parameters, stages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_core.api import Method, Stage
from splatwizard_core.tooling import build_schedulers, resolve
from sw_kit.finding import hold
from sw_kit.samples import TINY

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

ALWAYS = ("paper", "quick")
FILE = "or subclass sw_gaussians.method.GaussianMethod, whose file any codec writes"
NEEDED = {
    "stages": "def stages(self): return [YourStage(self.config)], a Stage or sw_gaussians.stage.ThreeDGSStage",
    "encode": f"def encode(self, model, writer): writer.add_array(name, array) for all that decode needs; {FILE}",
    "decode": f"def decode(self, reader): a model from reader.array(name, ...) alone; {FILE}",
}
"""Required attribute of a method -> code to write for it."""
START = (
    "def create_model(self, scene, generator): return gaussians_from_points(start_points(scene, self.name)), both of "
    "sw_gaussians.start; or subclass GaussianMethod, which does so; or starts_from = '3dgs' in the stage"
)


def check_configuration(entry: Entry, plugins: PluginManager) -> str:
    """Hold a method to what it declares: every preset with every rate point is a configuration, and has stages."""
    method: type[Method] = entry.load()
    hold(
        isinstance(method, type) and issubclass(method, Method),
        f"{entry.target} is no subclass of Method",
        "from splatwizard_core.api import Method",
    )
    hold(
        method.name == entry.name,
        f"the class is called '{method.name}', the entry '{entry.name}'",
        "use one name: it is written into files",
    )
    presets, rates = list(method.PRESETS), list(method.RATES)
    for key, names, default in (("presets", presets, list(ALWAYS)), ("rates", rates, ["r1"])):
        declared = list(entry.declared.get(key, default))
        hold(
            declared == names,
            f"{key} are declared as {declared}, the class has {names}",
            f"registry.add(..., {key}={names})",
        )
    for function, write in NEEDED.items():
        hold(getattr(method, function) is not getattr(Method, function), f"it has no {function}()", write)
    missing = [name for name in ALWAYS if name not in presets]
    hold(not missing, f"there is no preset {' and no '.join(missing)}", f"PRESETS = {{'{ALWAYS[0]}': {{}}, ...}}")
    hold(
        method.DEFAULT_RATE in rates,
        f"DEFAULT_RATE is '{method.DEFAULT_RATE}', rate points are {', '.join(rates)}",
        "name one of them",
    )
    undescribed = [name for name, field in method.Config.model_fields.items() if not field.description]
    hold(not undescribed, f"no description of {', '.join(undescribed)}", "Field(..., description=unit and meaning)")
    for family in method.BY_DATASET:
        resolve(method, ALWAYS[0], scene=f"{family}:{TINY}", plugins=plugins)  # raises for a wrong key or value
    for preset in presets:
        for rate in rates:
            resolved = resolve(method, preset, rate, scene=TINY, plugins=plugins)
            stages = list(method(plugins, resolved.config).stages())
            hold(
                stages and all(isinstance(stage, Stage) for stage in stages),
                f"stages() of preset '{preset}', rate '{rate}' are {stages}",
                "return one or more objects of Stage",
            )
            hold(
                stages[0].starts_from or method.create_model is not Method.create_model,
                f"it has no create_model(), and stage '{stages[0].name}' starts from no trained scene",
                START,
            )
            for stage in stages:
                build_schedulers(stage, resolved.ppl)  # raises for a task whose parameters cannot be supplied
    return f"{len(presets)} presets, {len(rates)} rate points, all of them valid"
