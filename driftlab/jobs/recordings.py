"""The recordings that a loop is given: none may both teach and judge, and each counts once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.config import Config, part_of, with_recording
from driftlab.recordings.identity import sha256
from driftlab.recordings.overlap import SMALL, Content, content_of
from driftlab.recordings.screening import read
from driftlab.storage.in_memory import InMemoryName
from fusion_core.errors import ConfigError
from fusion_core.faults import Faults

SAME = 0.9  # share of the samples from which on two recordings are one


class Recordings:
    """Recordings of a config as they are named on the command line, compared by their samples.

    Parts of one file are compared by their seconds; others by what they hold, so a recording that was packed
    otherwise, cut or shifted in time is still the same.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self._contents: dict[str, Content] = {}

    def distinct(
        self, calibration: Sequence[str], train: Sequence[str], holdout: Sequence[str]
    ) -> tuple[list[str], list[str]]:
        """Return calibration and train under one name each: what serves as both is called alike.

        Every part must have a recording, no sample may be in one twice, and none that teaches may judge.

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
                    if self.share(name, other) > SMALL:
                        raise ConfigError(
                            f"{option} {name}: has samples in common with {other}, and would count twice; name it once"
                        )
        for name in train:
            for other in calibration:
                if SMALL < self.share(name, other) < SAME:
                    raise ConfigError(
                        f"--train {name}: overlaps {other}, which was given for calibration, and would count twice; "
                        "give the same part as both, or parts that do not overlap"
                    )
        for name in holdout:
            for other in (*calibration, *train):
                if self.share(name, other) > SMALL:
                    raise ConfigError(
                        f"--holdout {name}: overlaps {other}, which was given for fitting, and cannot judge it; "
                        "name another recording"
                    )
        alike = [next((own for own in calibration if self.share(name, own) >= SAME), name) for name in train]
        return list(calibration), alike

    def share(self, name: str, other: str) -> float:
        """Return which share of the samples of the shorter recording is in both; 1 where one file's parts overlap."""
        (file, start, stop), (other_file, other_start, other_stop) = _span(name), _span(other)
        if file != other_file:
            return self._content(name).share(self._content(other))
        if (start, stop) == (other_start, other_stop):
            return 1.0
        return SAME / 2 if start < other_stop and other_start < stop else 0.0

    def _content(self, name: str) -> Content:
        if name not in self._contents:
            assert self.config.filter is not None
            channel = self.config.filter.tracked.channel
            chunks = read(with_recording(self.config, name), Faults())
            self._contents[name] = content_of((chunk for chunk in chunks if channel in chunk.channels), channel)
        return self._contents[name]


def _span(name: str) -> tuple[str, float, float]:
    if isinstance(name, InMemoryName):
        return name.identity()["sha256"], -np.inf, np.inf
    path, span = part_of(name)
    start, stop = span.get("start"), span.get("stop")
    return sha256(path), -np.inf if start is None else start, np.inf if stop is None else stop
