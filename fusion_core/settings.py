"""What every part of a configuration is: a frozen pydantic model that refuses what it does not know."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

from fusion_core.errors import shown


def _beside_config(value: Any, info: ValidationInfo) -> Any:
    folder = (info.context or {}).get("folder")
    text = None
    if isinstance(value, int | float):
        text = f"{value} is a number, a path is text; write it in quotes"
    elif isinstance(value, str) and not can_be_path(value):
        text = f"'{shown(value)}' cannot be a path; write a shorter one"
    if text is not None:
        raise PydanticCustomError("path", "{text}", {"text": text})
    return folder / value if folder and isinstance(value, str) and value != "-" else value


ConfigPath = Annotated[Path, BeforeValidator(_beside_config)]
"""A path in a config: a relative one is looked up beside the config file; `-` is standard input."""


def can_be_path(text: str) -> bool:
    """Whether a text can be the path of a file."""
    return "\0" not in text and len(text) < 4096 and all(len(part.encode()) < 256 for part in text.split("/"))


class Settings(BaseModel):
    """Base of every part of a config: frozen; a key that it does not know is an error, and so are NaN and infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", defer_build=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
    written_too: ClassVar[frozenset[str]] = frozenset()  # keys of the text that are read before the model sees it

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Describe `kind`, where there is one, by what the class says of itself."""
        super().__pydantic_init_subclass__(**kwargs)
        if "kind" in cls.model_fields and "kind" in cls.__annotations__ and not cls.model_fields["kind"].description:
            cls.model_fields["kind"].description = (cls.__doc__ or cls.__name__).partition("\n")[0]

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other fields; what was worked out from the old ones (cached properties) is left behind."""
        copy = super().model_copy(update=update, deep=deep)
        for name in copy.__dict__.keys() - type(copy).model_fields.keys():
            del copy.__dict__[name]
        return copy

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        known = {name for name, info in cls.model_fields.items() if info.init is not False} | cls.written_too
        for key in data if isinstance(data, dict) else ():
            if key not in known:
                hint = nearest(str(key), known)
                advice = f"did you mean '{hint}'?" if hint else f"known keys: {', '.join(sorted(known))}"
                raise PydanticCustomError("unknown_key", "{text}", {"text": f"unknown key; {advice}", "key": key})
        return data


def nearest(word: str, known: Any) -> str | None:
    """Return the known word most like `word`, or None."""
    found = difflib.get_close_matches(word, [str(k) for k in known], n=1, cutoff=0.5)
    return found[0] if found else None
