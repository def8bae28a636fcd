"""Output folders that are whole or not there, and the file of estimates."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.growing import GrowingFile, continued
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from driftlab.zupt import Zupt


@contextmanager
def output_folder(out: Path, mark: str = "summary.json", *, resume: bool = False) -> Iterator[Path]:
    """Give a folder `OUT.partial` to write to, and rename it to `out` when all went well.

    With `resume`, what an earlier run left in `OUT.partial` stays there. A folder of an earlier run of the command (it
    holds the file `mark`) is replaced, unless files of another command are in it; any other folder that is not empty
    is refused. When the run dies, what was written stays in `OUT.partial`.

    Raises
    ------
    ConfigError
        If `out` exists and is not the output of an earlier run.
    """
    if out.exists() and not (out / mark).exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"--out {out}: exists and is not the output of an earlier run; name another folder")
    partial = out.with_name(out.name + ".partial")
    try:
        if partial.exists() and not resume:
            shutil.rmtree(partial)
        partial.mkdir(parents=True, exist_ok=resume)
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be written ({error.strerror}); name a folder that can be") from None
    yield partial
    if out.exists():
        others = sorted({path.name for path in out.iterdir()} - {path.name for path in partial.iterdir()})
        if others:
            raise ConfigError(
                f"--out {out}: holds {', '.join(others)} of another command, which would be lost; "
                f"the new results are in {partial}, move them or name another folder"
            )
        shutil.rmtree(out)
    os.replace(partial, out)


def write_json(path: Path, content: Any) -> None:
    """Write JSON with null in place of NaN."""
    path.write_text(json.dumps(plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: arrays as lists, NaN as None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


UNITS = {
    "t": "s", "tau": "s", "white": "1", "nis": "1", "used": "1", "still": "1", "temperature": "degC",
    "temperature_rate": "K/s", "rate": "rad/s", "bias": "rad/s", "bias_sigma": "rad/s", "coast": "rad/s",
    "coast_sigma": "rad/s", "calibration": "rad/s",
}  # fmt: skip


# seven digits are enough for what is noise, or was measured in single precision
SINGLE = ("innovations", "white", "nis", "rate", "bias_sigma", "coast_sigma", "temperature", "temperature_rate")
SETTLING = ("sigma", "bias_sigma", "tau", "used", "still", "calibration")  # the same from update to update, before long


def estimates_file(path: Path, model: Zupt, attributes: dict[str, str], keep: int = 0) -> GrowingFile:
    """Return `estimates.h5`, to be written stretch by stretch (`Stretch.columns`); `keep` rows that are there stay.

    Every data set has its `unit`, time is its first axis.
    """
    states = ", ".join(model.units)
    units = UNITS | {"x": states, "sigma": states, "innovations": ", ".join(model.units[: model.m])}
    columns: dict[str, dict[str, Any]] = {name: {"unit": unit} for name, unit in units.items()}
    for name in ("x", "sigma"):
        columns[name]["labels"] = model.labels
    how = (attributes, columns, SINGLE, SETTLING)
    return continued(path, keep, *how) if keep else GrowingFile(path, *how)
