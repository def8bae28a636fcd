"""A recording whose truth is known: `driftlab simulate`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from driftlab.commands.console import print_json, say, say_lines
from driftlab.commands.inputs import ConfigLike, Place, Progress, config_of
from driftlab.commands.result import Result
from driftlab.config import Config, products
from driftlab.evaluation.overview import thin
from driftlab.live.pseudo_terminal import served_at
from driftlab.reports.charts import Chart, Clock, Line, Panel, series
from driftlab.storage.recorder import SIMULATED_UNITS, recording_file
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import Framing, SimulatedSource
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import Faults
from fusion_core.host.config import Document, validate
from fusion_core.host.registry import registry

ROWS = 65_536  # of a chunk made at once
PLAYED = 256  # of one that is played
COLUMNS = {"gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"], "temperature": ["T"]}
LINES = {  # of text, as a device sends that has no framing of its own
    "columns": ["n", *chain(*COLUMNS.values())],
    "channels": {name: {"path": names, "unit": SIMULATED_UNITS[name]} for name, names in COLUMNS.items()},
    "counter": {"field": "n", "modulo": 65536},
}


class SimulateResult(Result):
    """A simulated recording.

    In memory its arrays are `time` (N,) and the channels, in SI: with the true bias, `bias_truth` (N, d). Of what was
    written to a file there is none.

    Attributes
    ----------
    path : Path or None
        The file that was written, or the link to the device that was served.
    lost : int
        Bytes that were served and that nobody took.
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
        self.lost, self.left_out = tally.lost, tally.left_out
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
        lines = [f"{name}: has no place in the file; the same seed gives it in .h5" for name in self.left_out]
        if self.lost:
            lines.append(f"{self.lost:,} bytes were lost, since no program took them in time")
        return [*lines, *self._of_the_site()]

    def _of_the_site(self) -> list[str]:
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
        self.rows, self.first, self.last, self.lost = 0, np.nan, np.nan, 0
        self.names: tuple[str, ...] = ()
        self.left_out: tuple[str, ...] = ()

    def only(self, names: Collection[str]) -> None:
        """Note that of the channels only these were taken."""
        self.left_out = tuple(name for name in self.names if name not in ("time", *names))
        self.names = tuple(name for name in self.names if name not in self.left_out)

    def chunks(self, source: SimulatedSource, progress: Progress | None, size: int = ROWS) -> Iterator[Chunk]:
        """Yield every sample of the source."""
        for chunk in source.chunks(size, Faults()):
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
    framing: ConfigLike | None = None,
    serve: bool = False,
    speed: float = 1.0,
    opened: Callable[[Mapping[str, Any]], None] | None = None,
    progress: Progress | None = None,
) -> SimulateResult:
    """Simulate a recording: in a file, or out of a device.

    Parameters
    ----------
    config : as that of `run`
        With a source that simulates, as `source: {kind: synthetic}`.
    out : path, optional
        The recording: .h5, .csv, .xlsx, .ulg, .bin, .bag or .mcap.
        The samples are then there alone; they are in memory where it is left out. A file that was simulated before is
        replaced, any other is refused. With `serve` it is a link to the device, which goes with it.
    seed : int, optional
        Of the random numbers, instead of the config's.
    duration : str, optional
        E.g. '20 min', instead of the config's.
    framing : as config, optional
        Send what the device of this config sends.
        The config, or product, whose source has a framing; lines of text without it. In a file: the device's bytes.
    serve : bool
        Play it at true pace out of a pseudo-terminal.
        It begins when a program opens the device, and ends with the recording, or by Ctrl-C.
    speed : float
        Play it so many times faster.
    opened : callable, optional
        Called, once the device is there, with the section `source` of a config that reads it.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far.

    Returns
    -------
    SimulateResult
        `time` (N,), `gyro`, `accel`, `bias_truth` (N, 3), `temperature` (N,) in SI; `data` is that of `run`.

    Raises
    ------
    ConfigError
        If the source is none that simulates, a value is wrong, or `out` cannot be replaced.
    Unwritable
        If the disk is full, or the like.
    """
    understood = config_of(config)
    source = simulation(understood, seed, duration)
    if serve:
        link = None if out is None else Path(out)
        return _served(source, understood, link, framing_of(framing), speed, opened, progress)
    if speed != 1.0:
        raise ConfigError("--speed: is of a recording that is played; add --serve")
    if out is not None:
        return _written(source, understood, Path(out), progress, None if framing is None else framing_of(framing))
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


def framing_of(given: ConfigLike | None) -> Framing:
    """Return the framing of a config's source, or of a product; lines of text where none is given.

    Raises
    ------
    ConfigError
        If the config has none.
    """
    if given is None:
        return registry().classes(Framing)["text"].model_validate(LINES)  # type: ignore[return-value]
    if str(given) in products():
        given = {"extends": str(given), "source": {"kind": "serial", "port": "-", "interval": "1 s"}}
    framing = getattr(config_of(given).source, "framing", None)
    if not isinstance(framing, Framing):
        raise ConfigError(f"--framing {given}: its source has no framing; name a config with source: {{kind: serial}}")
    return framing


def _written(
    source: SimulatedSource, config: Config, out: Path, progress: Progress | None, framing: Framing | None = None
) -> SimulateResult:
    tally = _Tally()
    with recording_file(out, source.model_dump_json(exclude_none=True), framing) as file:
        for chunk in tally.chunks(source, progress):
            file.append(chunk)
        tally.only(file.names or tally.names)
    return SimulateResult(source, config, tally, None, out)


def _served(
    source: SimulatedSource,
    config: Config,
    link: Path | None,
    framing: Framing,
    speed: float,
    opened: Callable[[Mapping[str, Any]], None] | None,
    progress: Progress | None,
) -> SimulateResult:
    """Play a recording out of a device until it ends, or is interrupted."""
    if not 0 < speed < np.inf:
        raise ConfigError(f"--speed {speed:g}: more than 0 was expected; write e.g. 10")
    tally, sent = _Tally(), 0
    chunks = tally.chunks(source, progress, PLAYED)
    first = next(chunks)
    tally.last = tally.first
    step = float(first.t[1] - first.t[0]) if len(first) > 1 else 1.0
    with served_at(link) as terminal:
        said: dict[str, Any] = {
            "kind": "serial",
            "port": str(link or terminal.device),
            "interval": f"{step:.9g} s",
            "speed": speed,
        }
        said["framing"] = {"kind": framing.kind, **framing.model_dump(mode="json", exclude_unset=True)}
        with suppress(KeyboardInterrupt):
            if opened is not None:
                opened(said)
            terminal.wait()
            zero = time.monotonic() - float(first.t[0]) / speed
            for chunk in chain([first], chunks):
                terminal.play(chunk, framing, sent, speed, zero)
                sent, tally.last = sent + len(chunk), float(chunk.t[-1])
        tally.rows, tally.lost = sent, terminal.lost
    return SimulateResult(source, config, tally, None, link)


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments with what says how a device is read; raises ConfigError where nothing is to be made."""
    if not arguments.get("serve") and "out" not in arguments:
        raise ConfigError("--out: is missing; name a file, as FILE.h5, or play it out of a device with --serve")

    def opened(source: Mapping[str, Any]) -> None:
        if options.get("json"):
            print_json({"source": source}, None)
        else:
            text = yaml.safe_dump({"source": source}, sort_keys=False, default_flow_style=None, width=100)
            say(f"serving at {source['port']}, from when a program opens it; to read it:\n{text}")
        sys.stdout.flush()

    return {**arguments, "opened": opened}


def show(result: SimulateResult, given: Mapping[str, Any]) -> None:
    """Print what was written, or sent."""
    first, last = result.span
    span = f", t = {first:g} to {last:.10g} s" if result.rows else ""
    say(f"{result.name}: {result.rows:,} rows{span}\n")
    say_lines(result.lines(), "note: ")
    if not given.get("serve"):
        say(f"written to {result.path}: {', '.join(result.channels)}\n")
