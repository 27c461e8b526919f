"""The plan of a sweep: a TOML file, or the options of a command, checked before anything runs."""

from __future__ import annotations

import difflib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from splatwizard_core.api import ConfigError
from splatwizard_core.tooling import dotted, read_toml

LABEL = re.compile(r"[\w][\w.+-]*")
MAX_RUNS = 5_000
"""Runs of one sweep, not counting rate points; each is a line of every table about it."""
MAX_OVERRIDES = 1_000


def _seed(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise ValueError("a seed is a whole number of 0 or more, of at most 63 bits")
    return value


Seed = Annotated[int, BeforeValidator(_seed)]


class Table(BaseModel):
    """Base of all tables of a plan: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Values(Table):
    """Choices that any table of a plan may make; None leaves them to the tables before it.

    rates   names of rate points, or low, default, high, all
    set     keys of `--set`, nested or dotted
    """

    rates: str | None = None
    preset: str | None = None
    images: str | None = None
    set: dict[str, Any] = Field({})

    @field_validator("rates", mode="before")
    @classmethod
    def _joined(cls, value: Any) -> Any:
        return ",".join(map(str, value)) if isinstance(value, list) else value

    @field_validator("set")
    @classmethod
    def _flat(cls, value: dict[str, Any]) -> dict[str, Any]:
        found = dotted(value)
        if "seed" in found:
            raise ValueError("`seeds` of the plan gives the seeds, not `set`")
        return found


class MethodTable(Values):
    """Choices for one method of the plan; `method` names the method if the table's name is one of your own."""

    method: str | None = None


class Override(Values):
    """Choices where a method and a scene meet; an empty list means all. `skip` leaves these runs out."""

    methods: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    seeds: tuple[Seed, ...] = ()
    skip: bool = False

    def meets(self, label: str, scene: str, seed: int) -> bool:
        """Whether this table is about a run."""
        return all(not wanted or one in wanted for wanted, one in
                   ((self.methods, label), (self.scenes, scene), (self.seeds, seed)))  # fmt: skip


class Plan(Values):
    """All that a sweep is to run.

    out         root of the run directories
    methods     names, or names of tables [method.NAME]
    seeds       of every random stream
    device      auto, cpu or cuda
    rates       None: what `config` says, else the default of each method
    config      a file for `--config` of every run
    init        a .ply for `--init` of every run
    repeats     measurements of the rendering speed
    executor    where the runs happen
    options     of that executor
    """

    out: str | None = None
    methods: tuple[str, ...] = Field(min_length=1)
    scenes: tuple[str, ...] = Field(min_length=1)
    seeds: tuple[Seed, ...] = Field((0,), min_length=1)
    device: str | None = None
    config: str | None = None
    init: str | None = None
    geometry: bool = False
    repeats: int = Field(1, ge=1)
    executor: str = "local"
    options: dict[str, Any] = Field({})
    method: dict[str, MethodTable] = Field({})
    scene: dict[str, Values] = Field({})
    override: tuple[Override, ...] = ()

    def method_of(self, label: str) -> str:
        """Name of the method behind a name of the plan."""
        table = self.method.get(label)
        return label if table is None or table.method is None else table.method

    def values_for(self, label: str, scene: str, seed: int) -> Values | None:
        """Choices for one method on one scene with one seed, the later table winning; None: it is left out."""
        tables: list[Values] = [self.method.get(label, Values()), self.scene.get(scene, Values())]
        about = [each for each in self.override if each.meets(label, scene, seed)]
        if any(each.skip for each in about):
            return None
        found: dict[str, Any] = {name: getattr(self, name) for name in Values.model_fields}
        for table in [*tables, *about]:
            given = {name: getattr(table, name) for name in Values.model_fields}
            merged = {**found["set"], **given.pop("set")}
            found |= {name: value for name, value in given.items() if value is not None} | {"set": merged}
        return Values(**found)

    def part(self, methods: Iterable[str], scenes: Iterable[str], seeds: Iterable[int]) -> Plan:
        """Return the plan with these methods, scenes and seeds alone; an empty one of them leaves all."""
        wanted: dict[str, tuple[Any, ...]] = {
            "methods": tuple(methods), "scenes": tuple(scenes), "seeds": tuple(seeds)
        }  # fmt: skip
        for name, given in wanted.items():
            for each in given:
                known = [str(one) for one in getattr(self, name)]
                if str(each) not in known:
                    raise ConfigError(f"no {name[:-1]} of the plan is called '{each}': {_hint(str(each), known)}")
        return self.model_copy(update={name: given for name, given in wanted.items() if given})


def read_plan(path: str | Path) -> tuple[Plan, str]:
    """Read a plan and its text. Raises ConfigError that names the file and what is wrong in it."""
    content, text = read_toml(path, "the plan")
    return checked_plan(content, str(path)), text


def checked_plan(content: Mapping[str, Any], source: str) -> Plan:
    """Make the plan of these tables. Raises ConfigError; `source` says where they come from."""
    try:
        plan = Plan.model_validate(content)
    except ValidationError as error:
        raise ConfigError(_told(error, source)) from None
    runs = len(plan.methods) * len(plan.scenes) * len(plan.seeds)
    if runs > MAX_RUNS or len(plan.override) > MAX_OVERRIDES:
        raise ConfigError(
            f"{source}: {runs:,} runs (methods x scenes x seeds) and {len(plan.override):,} overrides; "
            f"{MAX_RUNS:,} and {MAX_OVERRIDES:,} are the most of one sweep: make several of it"
        )
    for kind, tables, known in (("method", plan.method, plan.methods), ("scene", plan.scene, plan.scenes)):
        for name in tables:
            if name not in known:
                raise ConfigError(f"{source}: [{kind}.{name}] is for none of `{kind}s`: {_hint(name, known)}")
    for i, each in enumerate(plan.override, 1):
        for name in ("methods", "scenes", "seeds"):
            there = [str(one) for one in getattr(plan, name)]
            for one in map(str, getattr(each, name)):
                if one not in there:
                    raise ConfigError(f"{source}: override {i}: '{one}' is none of `{name}`: {_hint(one, there)}")
    for name in ("methods", "scenes", "seeds"):
        twice, times = Counter(getattr(plan, name)).most_common(1)[0]
        if times > 1:
            raise ConfigError(f"{source}: '{twice}' stands twice in `{name}`: leave one out")
    for label in plan.methods:
        if not LABEL.fullmatch(label):
            raise ConfigError(f"{source}: '{label}' in `methods` cannot be the name of a folder")
    return plan


def set_words(values: Mapping[str, Any]) -> list[str]:
    """Spell values as those of `--set`."""
    return [f"{key}={_spelled(value)}" for key, value in values.items()]


def _spelled(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _told(error: ValidationError, source: str) -> str:
    """One line about the first thing that is wrong."""
    told = error.errors()  # what is wrong tells more than what is missing: it may be that, misspelt
    first = next((each for each in told if each["type"] not in ("missing", "too_short")), told[0])
    *where, last = first["loc"] or ("the plan",)
    place = ".".join(map(str, [*where, last]))
    if first["type"] == "extra_forbidden":
        table = {"method": MethodTable, "scene": Values, "override": Override}.get(str(where[0]) if where else "", Plan)
        return f"{source}: unknown key '{place}': {_hint(str(last), table.model_fields)}"
    if first["type"] in ("missing", "too_short"):
        return f"{source}: `{place}` is empty: there is nothing to run"
    reason = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{source}: bad value {first['input']!r} for '{place}': {reason}"


def _hint(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    return f"did you mean '{near[0]}'?" if near else f"there are {', '.join(names)}"
