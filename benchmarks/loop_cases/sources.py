"""Places of the measured recordings; a case whose recording is not there cannot be made, and says so."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np

from loop_cases.case import Array

ROOT = Path(__file__).parent.parent.parent
PLACEMENTS = ((300.0, 91_000.0), (94_500.0, 183_000.0), (186_000.0, np.inf))  # s; what is left out is handling
RAMPS = ("::0:9300", "::9300:18300", "::18300:")  # of the ovens, each from plateau to plateau


def spans(parts: Sequence[str]) -> list[tuple[float, float]]:
    """Return START and STOP of `::START:STOP`, in s."""
    return [tuple(float(x) if x else np.inf for x in part.split(":")[2:]) for part in parts]


def data(*parts: str) -> Path:
    """Return a path below the folder that DRIFTLAB_DATA names."""
    folder = os.environ.get("DRIFTLAB_DATA")
    if folder is None:
        raise FileNotFoundError("DRIFTLAB_DATA is not set; name the folder that has data/ and blind/")
    path = Path(folder).joinpath(*parts)
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there")
    return path


def cats() -> Path:
    """Return the CATS recording: DRIFTLAB_CATS, or where the demonstration keeps it, fetched if need be."""
    if "DRIFTLAB_CATS" in os.environ:
        return Path(os.environ["DRIFTLAB_CATS"])
    kept = ROOT / ".cache" / "cats_temperature_calib.nc"
    if kept.exists():
        return kept
    sys.path.insert(0, str(ROOT / "examples" / "01_cats"))
    from demo import recording

    return Path(recording())


@lru_cache(maxsize=1)
def cats_columns() -> dict[str, Array]:
    """Return the whole CATS recording: time (s), gyro (rad/s), accel (m/s^2), temperature (degC)."""
    with h5py.File(cats()) as file:
        return {
            "time": file["timestamp_utc"][()].astype(float),
            "gyro": file["angular_velocity"][()] * 1e-3,
            "accel": file["acceleration"][()],
            "temperature": file["temperature"][()],
        }


def table(path: Path) -> dict[str, Array]:
    """Return the columns of a CSV file with a heading."""
    content = np.genfromtxt(path, delimiter=",", names=True)
    return {name: np.asarray(content[name]) for name in content.dtype.names}
