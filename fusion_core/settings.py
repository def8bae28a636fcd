"""The base of every part of a configuration: a frozen pydantic model that refuses keys it does not know."""

from __future__ import annotations

import ast
import difflib
import inspect
import re
import textwrap
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetJsonSchemaHandler,
    ValidationInfo,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from fusion_core.errors import quote
from fusion_core.units import problem


def _beside_config(value: Any, info: ValidationInfo) -> Any:
    folder = (info.context or {}).get("folder")
    if isinstance(value, int | float):
        raise problem(f"{value} is a number, a path is text; write it in quotes")
    if isinstance(value, str) and not can_be_path(value):
        raise problem(f"'{quote(value)}' cannot be a path; write a shorter one")
    return folder / value if folder and isinstance(value, str) and value != "-" else value


ConfigPath = Annotated[Path, BeforeValidator(_beside_config)]
"""A path in a config: a relative one is looked up beside the config file; `-` is standard input."""


def can_be_path(text: str) -> bool:
    """Return True if a text can be the path of a file."""
    return "\0" not in text and len(text) < 4096 and all(len(part.encode()) < 256 for part in text.split("/"))


class Frozen(BaseModel):
    """Base of what is never changed, and holds nothing that it does not declare."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other fields; what was worked out from the old ones (cached properties) is left behind."""
        copy = super().model_copy(update=update, deep=deep)
        for name in copy.__dict__.keys() - type(copy).model_fields.keys():
            del copy.__dict__[name]
        return copy

    def __eq__(self, other: object) -> bool:
        """Return True if all fields are the same, whatever has been worked out from them since."""
        if other is self or type(other) is not type(self):
            return other is self
        mine, theirs = self.__dict__, other.__dict__
        for name in type(self).__pydantic_fields__:  # most are the same objects
            if mine[name] is not theirs[name] and mine[name] != theirs[name]:
                return False
        return True


class Settings(Frozen):
    """Base of every part of a config: a key that it does not know is an error, and so are NaN and infinity."""

    model_config = ConfigDict(defer_build=True, allow_inf_nan=False)
    written_too: ClassVar[frozenset[str]] = frozenset()  # keys of the text that are read before the model sees it

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Describe each field by the string below it, and `kind` by what the class says of itself.

        Only a schema needs them, and they are in the source: pydantic would read it whenever a class is made.
        """
        written = handler(schema)
        properties = handler.resolve_ref_schema(written).get("properties", {})
        for name, text in _descriptions(cls).items():
            if name in properties:
                properties[name]["description"] = text
        return written

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        known = {name for name, info in cls.model_fields.items() if info.init is not False} | cls.written_too
        for key in data if isinstance(data, dict) else ():
            if key not in known:
                advice = did_you_mean(str(key), known, f"known keys: {', '.join(sorted(known))}", "'")
                raise PydanticCustomError("unknown_key", "{text}", {"text": f"unknown key; {advice}", "key": key})
        return data


def _descriptions(cls: type[BaseModel]) -> dict[str, str]:
    """Return the string below each field of a class, its own before those of its bases, where the source is there."""
    texts = {}
    for base in reversed(cls.__mro__):
        if base is BaseModel or not issubclass(base, BaseModel):
            continue
        if "kind" in inspect.get_annotations(base):
            texts["kind"] = (base.__doc__ or base.__name__).partition("\n")[0]
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        for field, below in pairwise(getattr(body, "body", ())):
            text = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else None
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, str):
                texts[field.target.id] = inspect.cleandoc(text)
    return texts


AXIS = re.compile(r"(?<![A-Za-z])[xyzXYZ](?![A-Za-z])|[xyz]$|(?<=[a-z])[XYZ](?![a-z])")  # in a name


def nearest(word: str, known: Any, cutoff: float = 0.5) -> str | None:
    """Return the known word most like `word`, or None where none has the share `cutoff` of its letters in order.

    That of another axis is none that was meant.
    """
    axis = [found.lower() for found in AXIS.findall(word)]
    alike = [k for k in map(str, known) if not axis or [found.lower() for found in AXIS.findall(k)] in ([], axis)]
    matches = difflib.get_close_matches(word, alike, n=1, cutoff=cutoff)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Any, otherwise: str, mark: str = "", cutoff: float = 0.5) -> str:
    """Return the advice to take the known word most like `word`, between marks; what `otherwise` says where none is."""
    hint = nearest(word, known, cutoff)
    return f"did you mean {mark}{hint}{mark}?" if hint else otherwise
