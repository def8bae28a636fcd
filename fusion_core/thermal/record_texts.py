"""Names and other texts in the record of a map or of a family: short, to be seen, and on one line.

A record is made by this program, and read from files of strangers: a channel, a unit or an axis of theirs goes to
pages, parameter files and terminals. What is no name is refused where it is read.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator

from fusion_core.budget import COUNT, NAME, TEXT
from fusion_core.errors import UnitError, quote
from fusion_core.escaping import is_plain, line
from fusion_core.units import axis_names, si_unit_of

NAMED = re.compile(r"\w(?:[\w .:/()+-]*[\w)])?")  # a word, or several
COMMON = {"", "1", "rad/s", "m/s^2", "Pa"}  # units that need no look into the table of all


def check_name(text: str) -> str:
    """Return the name of a channel or a kind; raises ValueError where it is none."""
    if len(text) > NAME or not NAMED.fullmatch(text):
        raise ValueError(f"'{quote(text)}' is no name; write up to {NAME} letters and digits")
    return text


def check_plain(text: str) -> str:
    """Return a text of one line that can be seen; raises ValueError where it is another, or too long."""
    if len(text) > TEXT or not is_plain(text):
        raise ValueError(f"'{quote(text)}' is no text of one line with at most {TEXT} characters that can be seen")
    return text


def check_unit(text: str) -> str:
    """Return a unit that is known; raises ValueError where it is not."""
    try:
        if len(check_plain(text)) <= NAME and (text in COMMON or si_unit_of(text)):
            return text
    except UnitError:
        pass
    raise ValueError(f"the unit '{quote(text)}' is not known")


def check_tree(content: Any) -> Any:
    """Return JSON content whose texts are all plain; raises ValueError where one is not."""
    if isinstance(content, str):
        check_plain(content)
    elif isinstance(content, dict):
        for name, value in content.items():
            check_plain(name)
            check_tree(value)
    elif isinstance(content, list | tuple):
        for value in content:
            check_tree(value)
    return content


def recorded(provenance: Mapping[str, str]) -> dict[str, str]:
    """Return a provenance as a record may hold it: files are called as they like."""
    return {line(name): line(text)[:TEXT] for name, text in provenance.items()}


def _axes(names: tuple[str, ...]) -> tuple[str, ...]:
    return axis_names(names) if names else names


Name = Annotated[str, AfterValidator(check_name)]
Plain = Annotated[str, AfterValidator(check_plain)]
SiUnit = Annotated[str, AfterValidator(check_unit)]
AxisNames = Annotated[tuple[str, ...], AfterValidator(_axes)]


def parse_json(text: bytes | str, largest: float = 1e30) -> Any:
    """Return the content of JSON: no key twice, every number finite and at most `largest`, `COUNT` values at most.

    Raises
    ------
    ValueError
        If it is no JSON, or is of that kind; RecursionError where it is too deep.
    """

    def number(read: Callable[[str], float]) -> Callable[[str], float]:
        def checked(text: str) -> float:
            value = read(text)
            if not abs(value) <= largest:
                raise ValueError(f"the number {text[:20]} is beyond {largest:g}")
            return value

        return checked

    def constant(name: str) -> float:
        raise ValueError(f"{name} is not a number")

    if text.count("," if isinstance(text, str) else b",") > COUNT:  # type: ignore[arg-type]
        raise ValueError(f"it has more than {COUNT:,} values")
    how = {"parse_constant": constant, "parse_float": number(float), "parse_int": number(int)}
    return json.loads(text, object_pairs_hook=_once, **how)  # type: ignore[arg-type]


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names: set[str] = set()
        twice = next(name for name, _ in pairs if name in names or names.add(name))  # type: ignore[func-returns-value]
        raise ValueError(f"the key '{quote(twice)}' is there twice")
    return content
