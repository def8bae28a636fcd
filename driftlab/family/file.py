"""`family.json` written and read (`driftlab.family.mixed_model.Family`)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from driftlab import __version__
from driftlab.family.mixed_model import FROM_FILE, Family
from fusion_core.budget import read_whole
from fusion_core.errors import MapError, Unwritable, quote
from fusion_core.thermal.map_file import write_whole
from fusion_core.thermal.record_texts import parse_json


def save_family(
    path: Path, family: Family, *, map_kind: str = "", config: str = "",
    common_effects: dict[str, Any] | None = None, odd_lots: Sequence[str] = (),
) -> None:  # fmt: skip
    """Write a family, whole or not at all.

    Raises
    ------
    Unwritable
        If it cannot be written.
    """
    more = {"map_kind": map_kind, "config": config, "common_effects": common_effects, "odd_lots": tuple(odd_lots)}
    family = family.model_copy(update={"driftlab": __version__, **more})
    try:
        write_whole(path, json.dumps(family.model_dump(mode="json", by_alias=True)).encode())
    except OSError as error:
        raise Unwritable(
            f"{path} cannot be written ({error.strerror}); name a file in a folder that exists and can be written"
        ) from None


def load_family(
    path: Path, *, channel: str | None = None, bias_unit: str | None = None, axes: tuple[str, ...] | None = None
) -> Family:
    """Return the family of a file; `channel`, `bias_unit` and `axes` are the config's, None where any will do.

    Raises
    ------
    MapError
        If it cannot be read, is damaged, or is of another sensor.
    """
    try:
        text = read_whole(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise MapError(f"family {path} cannot be read ({why}); name the family.json of a fleet") from None
    damage = ""
    try:
        family = Family.model_validate(parse_json(text), context=FROM_FILE)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        damage = f": {quote('.'.join(map(str, first['loc']))) or 'file'}: {quote(first['msg'])}"
    except (ValueError, RecursionError) as error:
        damage = f" ({quote(error, 120)})"
    if damage:
        raise MapError(
            f"family {path} is damaged or no family's file{damage}; fit the family again with driftlab fleet"
        )
    for what, has, wanted in (
        ("channel", family.channel, channel), ("unit", family.bias_unit, bias_unit),
        ("axes", " ".join(family.axes), None if axes is None else " ".join(axes)),
    ):  # fmt: skip
        if wanted is not None and has != wanted:
            raise MapError(
                f"family {path} has the {what} {quote(has)}, the config {quote(wanted)}; name a family of the sensor "
                "that the config is about"
            )
    return family
