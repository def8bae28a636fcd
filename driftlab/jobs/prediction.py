"""`prediction.h5`: what was predicted of each holdout recording, before and after."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from driftlab import __version__

if TYPE_CHECKING:
    from driftlab.identification.result import Outcome


def write_prediction(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write a group for each holdout recording, named by its file's stem."""
    import h5py

    whole = io.BytesIO()  # HDF5 itself does not survive a full disk
    with h5py.File(whole, "w") as file:
        file.attrs["driftlab"] = __version__
        for outcome in outcomes:
            stem = Path(outcome.name.partition("::")[0]).stem
            name, k = stem, 2
            while name in file:
                name, k = f"{stem}_{k}", k + 1
            group = file.create_group(name)
            group.attrs["recording"] = Path(outcome.name).name
            group.create_dataset("t", data=outcome.t).attrs["unit"] = "s"
            group["t"].attrs["first_row"] = outcome.summaries[0]["t"]["first_row_s"]
            biases = {
                "reference": outcome.reference,
                "before": outcome.before,
                "after": outcome.after,
                "before_sigma": outcome.before_sigma,
                "after_sigma": outcome.after_sigma,
            }
            for column, values in biases.items():
                group.create_dataset(column, data=values).attrs["unit"] = outcome.unit.si
    path.write_bytes(whole.getbuffer())
