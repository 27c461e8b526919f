"""Rate points of every method of ours are one configuration to reports, also when runs are made again from files."""

from __future__ import annotations

import pytest
from sw_report.configurations import configurations
from sw_report.facts import RunFacts

from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs.config import resolve

METHODS = sorted(entry.name for entry in load_plugins().methods if is_ours(entry.distribution))


@pytest.mark.parametrize("name", METHODS)
def test_rate_points_are_one_configuration_to_reports(name):
    method = load_plugins().methods.entry(name).load()
    found = {}
    for preset in list(method.PRESETS)[:: max(1, len(method.PRESETS) - 1)]:  # the first and the last
        runs = []
        for rate in method.RATES:
            config = resolve(method, preset, rate, scene="demo").as_dict()
            from_file = {**config, "provenance": dict.fromkeys(config["config"], "out/config.toml")}
            runs += [
                RunFacts.model_validate({
                    "method": name, "scene": "demo", "protocol": {"id": "demo"}, "file": {"bytes": 1}, "metrics": {},
                    "preset": preset, "rate": rate, "config": each,
                }) for each in (config, from_file)
            ]  # fmt: skip
        for part in (runs, runs[::2], runs[1::2]):  # beside each other; as they were made; from files alone
            told = configurations(part)
            assert all(each == told[0] for each in told), preset
        found[preset] = told[0]
    texts = [tuple(sorted(each.items())) for each in found.values()]
    assert len(set(texts)) == len(texts)
