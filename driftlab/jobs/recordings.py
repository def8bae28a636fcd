"""The recordings that a loop is given: none may both teach and judge, and each counts once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.config import part_of
from driftlab.memory import Held
from driftlab.samples.identity import sha256
from fusion_core.errors import ConfigError


def distinct(calibration: Sequence[str], train: Sequence[str], holdout: Sequence[str]) -> None:
    """Check that every part has a recording, that no sample is in one twice, and that none that teaches judges.

    Raises
    ------
    ConfigError
        If one is missing, or has samples in common with another.
    """
    for option, names in (("--calibration", calibration), ("--train", train), ("--holdout", holdout)):
        if not names:
            raise ConfigError(f"{option} is missing; name at least one recording")
        for k, name in enumerate(names):
            for other in names[:k]:
                if _overlap(name, other):
                    raise ConfigError(
                        f"{option} {name}: has samples in common with {other}, and would count twice; name it once"
                    )
    for name in holdout:
        for other in (*calibration, *train):
            if _overlap(name, other):
                raise ConfigError(
                    f"--holdout {name}: overlaps {other}, which was given for fitting, and cannot judge it; "
                    "name another recording"
                )
    for name in train:
        for other in calibration:
            if _span(name) != _span(other) and _overlap(name, other):
                raise ConfigError(
                    f"--train {name}: overlaps {other}, which was given for calibration, and would count twice; "
                    "give the same part as both, or parts that do not overlap"
                )


def once(calibration: Sequence[str], train: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the recordings under one name each: what serves as calibration and train is called alike."""
    names = {_span(name): name for name in reversed(calibration)}
    return list(calibration), [names.get(_span(name), name) for name in train]


def _overlap(name: str, other: str) -> bool:
    """Return whether two recordings of the command line have samples in common."""
    (content, start, stop), (other_content, other_start, other_stop) = _span(name), _span(other)
    return content == other_content and start < other_stop and other_start < stop


def _span(name: str) -> tuple[str, float, float]:
    if isinstance(name, Held):
        return name.identity()["sha256"], -np.inf, np.inf
    path, span = part_of(name)
    start, stop = span.get("start"), span.get("stop")
    return sha256(path), -np.inf if start is None else start, np.inf if stop is None else stop
