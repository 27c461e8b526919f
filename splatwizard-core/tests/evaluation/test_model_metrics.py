"""Metrics over models: which evaluation they belong to, and that none harms another."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from splatwizard_core.api import CapabilityError, MetricResult
from splatwizard_core.errors import PluginError
from splatwizard_core.evaluation.evaluate import evaluate_model
from splatwizard_core.evaluation.metrics import chosen_metrics, metric_identities, quick_metrics
from splatwizard_core.plugins.registry import Entry, TypedRegistry


def area(subject: Any) -> MetricResult | None:
    return None if subject is None else MetricResult(2.5, [], "lower", details={"protocol": "toy", "parts": [1.0, 1.5]})


def not_a_number(subject: Any) -> MetricResult:
    return MetricResult(float("nan"), [], "lower")


def no_data(subject: Any) -> MetricResult:
    return MetricResult(1.0, [], "lower", details={"what": object()})


def lacking(subject: Any) -> MetricResult:
    raise CapabilityError("package-missing: get one")


def leaving(subject: Any) -> MetricResult:
    raise SystemExit(3)


def places(subject: Any) -> MetricResult:
    return MetricResult(1.5, [1.0, 2.0], "lower")


def picture(render: Any, truth: Any) -> float:
    return 1.0


@pytest.fixture
def registry() -> TypedRegistry[Any]:
    found: TypedRegistry[Any] = TypedRegistry("metric")
    for name, function in (("psnr", "picture"), ("area", "area"), ("nan", "not_a_number"), ("odd", "no_data"),
                           ("lacking", "lacking"), ("leaving", "leaving")):  # fmt: skip
        over = {} if name == "psnr" else {"over": "model"}
        declared = {"direction": "lower", **over}
        entry = Entry("metric", name, f"{__name__}:{function}", name, declared, "sw-toy", "1.0", foreign=True)
        found._entries[name] = entry
    return found


def test_they_are_asked_only_for_geometry_or_by_name(registry):
    def names(*given: Any, **how: Any) -> list[str]:
        return [entry.name for entry in chosen_metrics(registry, *given, **how)]

    assert names(None, geometry=False) == ["psnr"]
    assert names(None, geometry=True) == ["psnr", "area", "lacking", "leaving", "nan", "odd"]
    assert names(["area"], geometry=False) == ["area"]
    assert names(["area"], geometry=True) == ["area", "lacking", "leaving", "nan", "odd"]
    assert quick_metrics(registry) == ["psnr"]
    with pytest.raises(PluginError, match="nothing"):
        names(["nothing"], geometry=False)


def test_a_slow_diagnostic_is_measured_only_where_it_is_named(registry):
    for name, declared in (("costly", {"slow": True, "diagnostic": True}), ("slow", {"slow": True})):
        registry._entries[name] = Entry("metric", name, f"{__name__}:picture", "", declared, "sw-toy", "1.0")
    assert [e.name for e in chosen_metrics(registry, None, geometry=False)] == ["psnr", "slow"]
    assert [e.name for e in chosen_metrics(registry, ["costly"], geometry=False)] == ["costly"]
    assert quick_metrics(registry) == ["psnr"]


def test_one_that_breaks_costs_its_own_value_alone(registry):
    found = evaluate_model(SimpleNamespace(), chosen_metrics(registry, None, geometry=True))
    assert "psnr" not in found
    assert (found["area"].mean, found["area"].per_view) == (2.5, [])
    assert found["area"].details == {"protocol": "toy", "parts": [1.0, 1.5]}
    assert {name: each.mean for name, each in found.items() if name != "area"} == dict.fromkeys(
        ("nan", "odd", "lacking", "leaving")
    )
    assert found["lacking"].reason == "package-missing: get one"
    assert all("failed" in (found[name].reason or "") for name in ("nan", "odd", "leaving"))


def test_one_over_views_is_asked_always_and_keeps_its_values(registry):
    declared = {"direction": "lower", "over": "views", "diagnostic": True}
    registry._entries["places"] = Entry("metric", "places", f"{__name__}:places", "", declared, "sw-toy", "1.0")
    assert [e.name for e in chosen_metrics(registry, None, geometry=False)] == ["places", "psnr"]
    assert quick_metrics(registry) == ["psnr"]
    found = evaluate_model(SimpleNamespace(), chosen_metrics(registry, None, geometry=False))
    assert found == {"places": MetricResult(1.5, [1.0, 2.0], "lower", diagnostic=True)}


def test_one_that_does_not_apply_is_in_no_result(registry):
    assert evaluate_model(None, [registry.entry("area")]) == {}


def test_its_identity_is_asked_for_geometry_alone(registry):
    setup: Any = None
    assert list(metric_identities(chosen_metrics(registry, None, geometry=False), setup)) == ["psnr"]
    assert metric_identities(chosen_metrics(registry, None, geometry=True), setup)["area"] == "sw-toy 1.0"
