"""The state of a run in a file, so that it can go on after the program was killed.

A checkpoint is one NumPy archive: the arrays, and beside them a tree in JSON that says where each belongs. It is read
without running any code of the file (no pickle), and replaced in one step: there is always a whole one.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.filtering.coasting import Coast
from driftlab.filtering.segment import Stretches
from fusion_core.budget import PIECE, arrays_in, read_whole
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment
from fusion_core.errors import PluginError, UnreadableFile
from fusion_core.faults import Fault
from fusion_core.model import State

RECORDS = {cls.__name__: cls for cls in (Alignment, Chunk, Coast, Fault, State, Stretches)}


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint in the place of the one before.

    Raises
    ------
    PluginError
        If a plugin's memory holds something else than numbers, text, arrays, and tuples, lists and dicts of them.
    """
    arrays: dict[str, Array] = {}
    tree = json.dumps(_plain(content, arrays))
    whole = io.BytesIO()
    np.savez(whole, allow_pickle=False, tree=np.array(tree), **arrays)
    beside = path.with_name(path.name + ".new")
    beside.write_bytes(whole.getbuffer())
    os.replace(beside, path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint; raises UnreadableFile."""
    try:
        arrays = arrays_in(read_whole(path, PIECE))
        content: dict[str, Any] = _alive(json.loads(str(arrays["tree"])), arrays)
        return content
    except (OSError, ValueError, KeyError, TypeError, RecursionError, zipfile.BadZipFile) as error:
        raise UnreadableFile(f"{path}: is not a checkpoint ({error}); begin anew without --resume") from None


def _plain(value: Any, arrays: dict[str, Array]) -> Any:
    """Return the value as JSON; containers other than lists are objects with one key that says what they are."""
    if value is None or (isinstance(value, bool | int | float | str) and not isinstance(value, np.generic)):
        return float(value) if isinstance(value, float) else value
    if isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype.kind in "biufU":
        name = f"a{len(arrays)}"
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, list):
        return [_plain(item, arrays) for item in value]
    if isinstance(value, frozenset):
        return {"set": [_plain(item, arrays) for item in sorted(value)]}
    if isinstance(value, tuple):
        return {"tuple": [_plain(item, arrays) for item in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_plain(key, arrays), _plain(item, arrays)] for key, item in value.items()]}
    name = type(value).__name__
    if is_dataclass(value) and RECORDS.get(name) is type(value):
        return {name: {field.name: _plain(getattr(value, field.name), arrays) for field in fields(value)}}
    raise PluginError(
        f"a memory holds a {type(value).__module__}.{name}, which a checkpoint cannot keep; numbers, text, arrays, and "
        "tuples, lists and dicts of them were expected"
    )


def _alive(value: Any, arrays: Any) -> Any:
    if isinstance(value, list):
        return [_alive(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    ((what, inside),) = value.items()
    if what == "array":
        array = arrays[inside]
        return array[()] if array.ndim == 0 else array
    if what == "set":
        return frozenset(_alive(item, arrays) for item in inside)
    if what == "tuple":
        return tuple(_alive(item, arrays) for item in inside)
    if what == "dict":
        return {_alive(key, arrays): _alive(item, arrays) for key, item in inside}
    return RECORDS[what](**{name: _alive(item, arrays) for name, item in inside.items()})
