"""Options of writers: named, typed values with a few bounds."""

from __future__ import annotations

import difflib
from typing import Any, ClassVar, get_type_hints

from splatwizard_core.api import UserInputError


class Options:
    """Values of a writer; a subclass names them as class attributes.

    choices     name -> what it may be: a tuple of values, or a range of whole numbers
    """

    choices: ClassVar[dict[str, tuple[Any, ...] | range]] = {}

    def __init__(self, **values: Any) -> None:
        known = {name: kind for name, kind in get_type_hints(type(self)).items() if name != "choices"}
        for name, value in values.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f"did you mean '{near[0]}'?" if near else f"there are: {', '.join(known) or 'none'}"
                raise UserInputError(f"no option '{name}' of this format; {hint}")
            legal = self.choices.get(name)
            if legal is not None and value not in legal:
                raise UserInputError(f"option '{name}' is {value!r}; it may be {_told(legal)}")
            setattr(self, name, value)


def _told(legal: tuple[Any, ...] | range) -> str:
    """The values in words: whole numbers in sequence by the first and the last."""
    if isinstance(legal, range):
        return f"{legal[0]} to {legal[-1]}"
    if len(legal) > 8 and legal[0] is None:
        return f"None, or {legal[1]} to {legal[-1]}"
    return ", ".join(map(str, legal))
