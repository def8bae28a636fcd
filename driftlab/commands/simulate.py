"""A recording whose truth is known: `driftlab simulate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.commands.console import say, say_lines
from driftlab.commands.inputs import ConfigLike, Place, Progress, config_of
from driftlab.commands.result import Result
from driftlab.config import Config
from driftlab.evaluation.overview import thin
from driftlab.reports.charts import Chart, Clock, Line, Panel, series
from driftlab.storage.recorder import SIMULATED_UNITS, recording_file
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import SimulatedSource
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import Faults
from fusion_core.host.config import Document, validate

ROWS = 65_536  # of a chunk made at once


class SimulateResult(Result):
    """A simulated recording.

    In memory its arrays are `time` (N,) and the channels, in SI: with the true bias, `bias_truth` (N, d). Of what was
    written to a file there is none.

    Attributes
    ----------
    path : Path or None
        The file that was written.
    rows : int
        How many samples there are.
    span : (float, float)
        The first and the last time, s.
    channels : dict of str to str or None
        Unit of `time` and of each channel; None where it is not known.
    """

    def __init__(
        self, source: SimulatedSource, config: Config, tally: _Tally, samples: Chunk | None, path: Path | None
    ) -> None:
        self.source, self.config, self.name, self.path = source, config, source.name, path
        self.rows, self.span = tally.rows, (tally.first, tally.last)
        self.channels: dict[str, str | None] = {name: SIMULATED_UNITS.get(name) for name in tally.names}
        self.units = {name: unit for name, unit in self.channels.items() if unit is not None}
        self._columns = {} if samples is None else {"time": samples.t, **samples.channels}
        self.labels = {name: ("x", "y", "z") for name, values in self._columns.items() if values.shape[1:] == (3,)}
        self.summary = {
            "path": None if path is None else str(path),
            "source": self.name,
            "rows": self.rows,
            "first_s": self.span[0],
            "last_s": self.span[1],
            "units": self.channels,
            "notes": self.lines(),
        }

    def lines(self) -> list[str]:
        """Return the notes on the recording and the rest of the config."""
        config = self.config
        site = self.source.site
        if config.latitude is None or site is None or site.latitude == config.latitude:
            return []
        simulated = site.latitude
        have = "has no Earth rate" if simulated is None else f"is at latitude {np.rad2deg(simulated):.6g} deg"
        return [
            f"the recording {have}, and latitude is {np.rad2deg(config.latitude):.6g} deg in the rest of the config; "
            "write the same under source.latitude"
        ]

    def _chart(self) -> Chart:
        """Return every channel over time, below one another."""
        time = self._columns["time"]
        rows, clock = thin(len(time)), Clock(float(time[0]), float(time[-1]))
        t, panels = clock(time[rows]), []
        for name, whole in self._columns.items():
            if name == "time":
                continue
            values = whole[rows].reshape(len(rows), -1)
            d = values.shape[1]
            texts = [name] if d == 1 else self.labels.get(name) or [str(k) for k in range(d)]
            roles = ["data"] if d == 1 else [series(k) for k in range(d)]
            lines = tuple(Line(t, *column) for column in zip(values.T, texts, roles, strict=True))
            panels.append(Panel(lines, f"{name} [{self.units[name]}]" if name in self.units else name))
        return Chart(tuple(panels), f"time [{clock.unit}]", "Every channel")

    def save(self, out: str | PathLike[str]) -> None:
        """Write the same samples to a file, as `driftlab simulate` does."""
        _written(self.source, self.config, Path(out), None)


class _Tally:
    """Rows, the first and the last time, and the names of the channels of the samples that went by."""

    def __init__(self) -> None:
        self.rows, self.first, self.last = 0, np.nan, np.nan
        self.names: tuple[str, ...] = ()

    def chunks(self, source: SimulatedSource, progress: Progress | None) -> Iterator[Chunk]:
        """Yield every sample of the source."""
        for chunk in source.chunks(ROWS, Faults()):
            self.first = float(chunk.t[0]) if self.rows == 0 else self.first
            self.rows, self.last = self.rows + len(chunk), float(chunk.t[-1])
            self.names = ("time", *chunk.channels)
            yield chunk
            if progress is not None:
                progress(self.last, self.rows)
        if self.rows == 0:
            raise EmptyRecording(f"{source.name}: gave no sample; write a longer duration")


def simulate(
    config: ConfigLike,
    *,
    out: Place | None = None,
    seed: int | None = None,
    duration: str | None = None,
    progress: Progress | None = None,
) -> SimulateResult:
    """Write a simulated recording, with its true bias, to a file.

    Parameters
    ----------
    config : as that of `run`
        With a source that simulates, as `source: {kind: synthetic}`.
    out : path, optional
        The recording: FILE.h5 or FILE.csv.
        The samples are then there alone; they are in memory where it is left out. A file that was simulated before is
        replaced, any other is refused.
    seed : int, optional
        Of the random numbers, instead of the config's.
    duration : str, optional
        E.g. '20 min', instead of the config's.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far.

    Returns
    -------
    SimulateResult
        `time` (N,), `gyro`, `accel`, `bias_truth` (N, 3), `temperature` (N,) in SI; `data` for the other functions.

    Raises
    ------
    ConfigError
        If the source is none that simulates, a value is wrong, or `out` cannot be replaced.
    Unwritable
        If the disk is full, or the like.
    """
    understood = config_of(config)
    source = simulation(understood, seed, duration)
    if out is not None:
        return _written(source, understood, Path(out), progress)
    tally = _Tally()
    samples = concatenate(tally.chunks(source, progress))
    return SimulateResult(source, understood, tally, samples, None)


def simulation(config: Config, seed: int | None, duration: str | None) -> SimulatedSource:
    """Return the config's source, with another seed and duration in place of its own; raises ConfigError."""
    source = config.source
    if source is None:
        raise ConfigError("source: is missing; write source: {kind: synthetic}")
    if not isinstance(source, SimulatedSource):
        raise ConfigError(f"source: kind {source.kind} does not simulate; write source: {{kind: synthetic}}")
    given = {"seed": seed, "duration": duration}
    update = {name: value for name, value in given.items() if value is not None}
    return validate(type(source), Document(Path("command line"), {**dict(source), **update})) if update else source


def _written(source: SimulatedSource, config: Config, out: Path, progress: Progress | None) -> SimulateResult:
    tally = _Tally()
    with recording_file(out, source.model_dump_json(exclude_none=True)) as file:
        for chunk in tally.chunks(source, progress):
            file.append(chunk)
    return SimulateResult(source, config, tally, None, out)


def show(result: SimulateResult, given: Mapping[str, Any]) -> None:
    """Print what was written."""
    first, last = result.span
    say(f"{result.name}: {result.rows:,} rows, t = {first:g} to {last:.10g} s\n")
    say_lines(result.lines(), "note: ")
    say(f"written to {result.path}: {', '.join(result.channels)}\n")
