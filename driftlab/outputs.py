"""Output folders that are whole or not there, and the file of estimates."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import h5py

    from driftlab.tracker import Stretch
    from driftlab.zupt import Zupt


@contextmanager
def output_folder(out: Path, mark: str = "summary.json") -> Iterator[Path]:
    """Give a folder `OUT.partial` to write to, and rename it to `out` when all went well.

    A folder of an earlier run of the command (it holds the file `mark`) is replaced, unless files of another command
    are in it; any other folder that is not empty is refused. When the run dies, what was written stays in
    `OUT.partial`.

    Raises
    ------
    ConfigError
        If `out` exists and is not the output of an earlier run.
    """
    if out.exists() and not (out / mark).exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"--out {out}: exists and is not the output of an earlier run; name another folder")
    partial = out.with_name(out.name + ".partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
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
    "t": "s", "tau": "s", "white": "1", "nis": "1", "used": "1", "rate": "rad/s", "bias": "rad/s",
    "bias_sigma": "rad/s", "coast": "rad/s", "calibration": "rad/s", "temperature": "degC", "temperature_rate": "K/s",
}  # fmt: skip


class EstimatesFile:
    """`estimates.h5`, written stretch by stretch. Every data set has its `unit`, time is its first axis."""

    def __init__(self, path: Path, model: Zupt, attributes: dict[str, str]) -> None:
        import h5py

        self._file: h5py.File = h5py.File(path, "w")
        self._file.attrs.update(attributes)
        self._labels = model.labels
        states = ", ".join(model.units)
        self._units = UNITS | {"x": states, "sigma": states, "innovations": ", ".join(model.units[: model.m])}

    def append(self, stretch: Stretch) -> None:
        """Add one stretch, flushed to disk."""
        for name, values in stretch.columns().items():
            data = self._file.get(name)
            if data is None:
                rows = max(1, 2**17 // max(1, values[:1].nbytes))
                data = self._file.create_dataset(
                    name, (0, *values.shape[1:]), values.dtype, maxshape=(None, *values.shape[1:]),
                    chunks=(rows, *values.shape[1:]),
                )  # fmt: skip
                data.attrs["unit"] = self._units[name]
                if name in ("x", "sigma"):
                    data.attrs["labels"] = self._labels
            data.resize(len(data) + len(values), axis=0)
            data[len(data) - len(values) :] = values
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_estimates(path: Path) -> dict[str, Array]:
    """Read the data sets of `estimates.h5` by name."""
    import h5py

    with h5py.File(path) as file:
        return {name: data[()] for name, data in file.items()}
