"""docs/plugins.md as a reference: its signatures, fields and tables are those of the contracts."""

from __future__ import annotations

import dataclasses
import inspect
import re
from typing import Any

import pytest
from plugin_page import SECTIONS
from sw_kit.checks.fields import FIELDS, SORTS

from splatwizard_core import api
from splatwizard_core.errors import UserInputError
from splatwizard_core.evaluation.metrics import MetricFactory, MetricInfo
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.check import Check
from splatwizard_core.rendering.features import Feature
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.runs.observers import TrainingObserver
from splatwizard_core.training.scheduler import Scheduler
from splatwizard_core.training.tasks import SOURCES

CONTRACTS: dict[str, list[Any]] = {
    "The hooks": [api.Registry],
    "register_rasterizers": [api.Rasterizer],
    "register_pruners": [api.Pruner],
    "register_quantizers": [api.Quantizer],
    "register_entropy_models": [api.EntropyModel],
    "register_context_models": [api.ContextModel],
    "register_coders": [api.EntropyCoder, api.PositionCodec, api.ArrayCoder, api.VectorCoder, api.GaussianCodec],
    "register_density_controls": [api.DensityControl],
    "register_methods": [api.Method],
    "register_datasets": [api.Dataset],
    "register_metrics": [MetricFactory],
    "run_started": [TrainingObserver],
    "Stages": [api.Stage],
}
ONLY = {api.Registry: ["add"], api.ContextModel: ["__call__"]}


def members(contract: type) -> list[str]:
    """Names of what a contract asks for."""
    if contract in ONLY:
        return ONLY[contract]
    public = [name for name in {**vars(contract), **contract.__annotations__} if not name.startswith("_")]
    made = ["__init__"] if contract in (api.Method, api.Stage) else []
    return [*made, *public]


def bare_signature(function: Any) -> str:
    """Names and defaults of the parameters, as the page shows them."""
    signature = inspect.signature(function)
    kept = [p.replace(annotation=p.empty) for p in signature.parameters.values() if p.name != "self"]
    return str(signature.replace(parameters=kept, return_annotation=signature.empty))


@pytest.mark.parametrize("title", CONTRACTS)
def test_signatures_are_those_of_the_contracts(title):
    for contract in CONTRACTS[title]:
        for name in members(contract):
            member = inspect.getattr_static(contract, name, None)
            text = f"{name}{bare_signature(member)}" if inspect.isfunction(member) else name
            shown = re.search(rf"^    (?:.*\W)?{re.escape(text)}", SECTIONS[title], re.M)
            assert shown, f"{title}: {contract.__name__} has {text}"


def test_the_signature_of_register_task():
    assert f"scheduler.register_task{bare_signature(Scheduler.register_task)}" in SECTIONS["register_tasks"]


def test_every_annotation_that_a_task_may_have_is_listed():
    told = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", SECTIONS["register_tasks"], re.M))))
    assert {source.__name__ for source in SOURCES} | {"int"} <= told


def test_every_feature_is_listed_with_what_asks_for_it():
    rows = "".join(re.findall(r"^\| (`.*?) \|", SECTIONS["register_rasterizers"], re.M))
    assert sorted(re.findall(r"`(\w+)`", rows)) == sorted(Feature.__members__)


def test_every_field_that_an_entry_may_declare_is_told():
    declared: dict[str, Any] = {f"register_{kind}s": fields for kind, fields in FIELDS.items()}
    declared["register_metrics"] = {*FIELDS["metric"], *(f.name for f in dataclasses.fields(MetricInfo))}
    known = {f.name for f in dataclasses.fields(RasterizerInfo)} - {"name", "per_device"}
    declared["register_rasterizers"] = {*known, "on"}
    for title, names in declared.items():
        assert [name for name in names if f"`{name}`" not in SECTIONS[title]] == [], title


def test_what_a_stage_is_handed_is_told():
    told = re.findall(r"^\| `(\w+)(?:\(\w+\))?` \|", SECTIONS["Stages"], re.M)
    assert told == [field.name for field in dataclasses.fields(api.StageContext)]


def test_the_fields_of_a_check_are_told():
    told = re.search(r"Check\((.*)\)\n", SECTIONS["register_checks"]).group(1)
    assert re.findall(r"(\w+)(?:=[^,]*)?(?:, |$)", told) == [field.name for field in dataclasses.fields(Check)]


VALUES = [
    api.Camera, api.View, api.Scene, api.SceneOptions, api.SplatModel, api.GaussianModel, api.GaussianInputs, api.SH,
    api.RasterOptions, api.ScoreSpec, api.RenderResult, api.OptimizationParams, api.PipelineParams, api.SplatOptimizer,
    api.CameraSampler, api.ContainerWriter, api.ContainerReader,
]  # fmt: skip
SET_WHEN_MADE = {"static", "raster", "version", "active_sh_degree", "views", "generator"}
"""Attributes that a class does not name outside its `__init__`."""


@pytest.mark.parametrize("cls", VALUES, ids=lambda cls: cls.__name__)
def test_values_have_what_the_page_says(cls):
    rows = re.findall(r"^\| (`.*?) \|", SECTIONS[cls.__name__], re.M)
    told = dict(re.match(r"(\w+)(.*)", each).groups() for row in rows for each in re.findall(r"`(.+?)`", row))
    fields = {f.name for f in dataclasses.fields(cls) if f.init} if dataclasses.is_dataclass(cls) else set()
    fields |= set(getattr(cls, "model_fields", ()))
    assert fields <= told.keys()
    for name, parameters in told.items():
        member = inspect.getattr_static(cls, name, None)
        if not parameters:
            named = {name} & {*fields, *SET_WHEN_MADE, *cls.__annotations__, *vars(cls)}
            assert named, f"{cls.__name__} has no {name}"
            assert not inspect.isfunction(member), f"{cls.__name__}.{name} is a function"
            continue
        signature = bare_signature(getattr(cls, name))
        assert parameters == re.sub(r"<function [^>]*>", "...", signature), f"{cls.__name__}.{name}"


def test_functions_have_the_signatures_of_the_page():
    rows = re.findall(r"^\| `(\w+)(\(.*?\))` \|", SECTIONS["Functions"], re.M)
    public = {name for name in api.__all__ if inspect.isroutine(getattr(api, name))} - {"hookimpl"}
    assert {name for name, _ in rows} == public
    for name, parameters in rows:
        assert parameters == bare_signature(getattr(api, name)), name


def test_errors_carry_the_facts_of_the_page():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|", SECTIONS["Errors"], re.M))
    input_errors = [name for name in rows if issubclass(getattr(api, name), UserInputError)]
    bases = ["SplatwizardError", "UserInputError"]
    assert [*rows] == [*bases, *input_errors[1:], "EmptyModel"]
    for name in input_errors:
        told = re.search(r"\[(.*)\]", rows[name])
        facts = re.findall(r"\w+", told.group(1)) if told else []
        keywords = inspect.signature(getattr(api, name).__init__).parameters.values()
        assert facts == [p.name for p in keywords if p.kind is p.KEYWORD_ONLY], name


def test_every_registry_is_told_with_its_hook():
    plugins = load_plugins()
    rows = dict(re.findall(r"^\| `(register_\w+)` \| `plugins\.(\w+)`", SECTIONS["The hooks"], re.M))
    assert rows.keys() == plugins._filled_by.keys()
    for hook, name in rows.items():
        assert getattr(plugins, name) is plugins._filled_by[hook]
    sorts = dict(
        re.findall(r"^\| `\"(\w+)\"` \|.*`plugins\.(\w+)\.load\(name\)` \|", SECTIONS["register_coders"], re.M)
    )
    assert sorts.keys() == set(SORTS)
    assert all(getattr(plugins, name).codes == codes for codes, name in sorts.items())
