"""The rules that one scene is read by, decided from the family's table and from the user's options."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

from splatwizard_core.api import ConfigError, Protocol, SceneOptions
from sw_datasets.families import PROTOCOLS, Family

MOST_POINTS = 100_000_000  # random start points: 2.4 GB


@dataclass(frozen=True)
class Rules:
    """Rules that one scene is read by.

    family      row of the table
    scene       its published scene, None for any other folder
    asked       named protocol whose pictures are the default
    images      picture folder; None: the layout has none to choose
    masked      pictures are cut out by alpha or mask; None: by alpha, if the family composites it
    exif_turn   as in SceneOptions
    points      as in Protocol, "train" or "all"; empty: as the split asks
    finds_lists lists of names in the scene decide its split, as the user named none and nothing is published
    the rest    as in Protocol
    """

    family: Family
    scene: str | None
    asked: str
    images: str | None
    resolution: int
    split: str
    background: str
    principal_point: str
    masked: bool | None
    composite8: bool
    exif_turn: bool | None
    points: str = ""
    finds_lists: bool = False

    @property
    def cuts_alpha(self) -> bool:
        """Whether pictures with alpha are composited on the background."""
        return self.family.composites if self.masked is None else self.masked

    @property
    def name(self) -> str:
        """The named protocol that these very rules are, else "custom"."""
        if self.scene is None:
            return "custom"
        plain = (self.family.split, self.family.background, self.family.principal_point, False)
        if (self.split, self.background, self.principal_point, self.composite8) != plain:
            return "custom"
        for name in (self.asked, *PROTOCOLS):
            pictures = self.family.pictures[name]
            if (self.images, self.resolution) == (pictures.folder_of(self.scene), pictures.resolution):
                return name
        return "custom"

    def protocol(self, label: str | None = None, *, masked: bool = False, turned: bool = False) -> Protocol:
        """The protocol that the record keeps.

        label   stands for the picture folder where the layout has none
        masked  pictures were cut out by alpha or mask, beyond what the layout always does
        turned  pictures were turned by EXIF because the user said so
        """
        return Protocol(
            self.family.name,
            images=self.images or label or "",
            resolution=self.resolution,
            split=self.split,
            background=self.background,
            principal_point=self.principal_point,
            masked=masked,
            composite8=self.composite8,
            turned=turned,
            points=self.points,
            name="custom" if masked or turned else self.name,
        )


def rules_for(family: Family, folder: str, options: SceneOptions) -> Rules:
    """Decide the rules for a scene folder: the user's options, else the values of the family's table.

    folder  name of the scene's folder

    Raises ConfigError for two splits at once, for a picture folder where there is none to choose, and for a number of
    start points that makes no sense.
    """
    if not 0 <= options.init_points <= MOST_POINTS:
        raise ConfigError(
            f"init_points is {options.init_points}: must be a number of points from 0 to {MOST_POINTS:,}",
            key="init_points",
        )
    if options.split is not None and options.test_every is not None and options.split != f"every{options.test_every}":
        raise ConfigError(
            f"split = {options.split} contradicts test_every = {options.test_every}: give one of them", key="split"
        )
    scene = family.scene_of(folder)
    asked = options.protocol or PROTOCOLS[0]
    pictures = family.pictures[asked]
    images = pictures.folder_of(scene or folder)
    if options.images is not None:
        if images is None:
            raise ConfigError(
                f"--images {options.images}: there is no picture folder to choose in a scene of the family "
                f"'{family.name}'; leave it out",
                key="images",
            )
        images = options.images
    split = options.split or (family.split if options.test_every is None else f"every{options.test_every}")
    return Rules(
        family,
        scene,
        asked,
        images,
        pictures.resolution if options.resolution is None else options.resolution,
        split,
        options.background or family.background,
        options.principal_point or family.principal_point,
        options.mask_background,
        options.legacy_8bit_composite,
        options.exif_turn,
        (options.points or "").removesuffix("-tracks"),
        finds_lists=options.split is None and options.test_every is None and not family.scenes,
    )


def unused_option_warnings(options: SceneOptions, keys: Iterable[str], family: Family) -> list[str]:
    """Warn of each of `keys` that was given a value although scenes of the family have no use for it.

    A named protocol is of no use where nothing is published.
    """
    defaults = {f.name: f.default for f in fields(SceneOptions)}
    keys = [*keys] if family.scenes else ["protocol", *keys]
    given = [key for key in keys if getattr(options, key) != defaults[key]]
    return [f"{key} = {getattr(options, key)} is of no use for a scene of the family '{family.name}'" for key in given]
