"""JSON files, and values as JSON has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fusion_core.escaping import json_text


def write_json(path: Path, content: Any) -> None:
    """Write JSON with null in place of NaN."""
    path.write_text(text_of(content), encoding="utf-8")


def text_of(content: Any) -> str:
    """Return JSON with null in place of NaN."""
    return json_text(plain(content), 2, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: arrays as lists, NaN as None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
