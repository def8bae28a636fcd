"""Placements at rest, by hand, by faces or in a tumble over temperature: their rests, and the inputs that they show.

N samples, P placements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import KnownRates, PlacedForces, PlacedRates, Site, Stimulus, TriadInput
from fusion_core.errors import ConfigError, MissingChannel, NotAtRest
from fusion_core.units import Quantity, Unit
from fusion_plugins.earth import STANDARD_GRAVITY
from fusion_plugins.stimuli.tables import Files, file_of, halved, rows_of, segments

WINDOW = 0.5  # s, over which the scatter of a triad is looked at
QUIET = 4.0  # times the scatter of the quietest tenth of the windows: more is motion
EDGE = 0.25  # s, left out at both ends of a rest


class PlacedStimulus(Stimulus):
    """Placements at rest, of which gravity is known."""

    placements: Files | None = None
    """Table of placements (start, stop), CSV; found by the rests of the sensors where it is left out."""
    rest: Annotated[float, Unit("s", positive=True, example="2 s")] = Quantity(2.0, "2 s")
    """Least duration of a rest."""
    gravity: Annotated[float, Unit("m/s^2", positive=True, example="9.81 m/s^2")] | None = None
    """Local gravity; by latitude where it is left out."""

    def inputs(
        self, recordings: Sequence[Chunk], channel: str, site: Site, length: tuple[float, float] | None
    ) -> TriadInput:
        """Return gravity's length at the placements of accelerometers, or the turns between those of a gyro."""
        parts = [self._places(chunk, k) for k, chunk in enumerate(recordings)]
        if channel == "gyro":
            if len(recordings) > 1:
                raise ConfigError(
                    "positions of a gyro: are of one recording, in which it is turned; name one with --input"
                )
            return placed_rates(recordings[0], parts[0])
        if length is None:
            raise ConfigError(f"stimulus: kind {self.kind} is for an accelerometer or a gyro, not for {channel}")
        gravity, unsure = length if self.gravity is None else (float(self.gravity), 0.0)
        halves = _forces(recordings, channel, list(map(halved, parts)), gravity)
        return replace(_forces(recordings, channel, parts, gravity), unsure=unsure / gravity, parts=halves)

    def _places(self, chunk: Chunk, k: int) -> list[tuple[int, int]]:
        if self.placements:
            table = segments(file_of(self.placements, k), rates=False)
            return [rows_of(chunk.t, part.start, part.stop) for part in table]
        triads = [chunk[name] for name in ("accel", "gyro") if name in chunk.channels]
        return rests(chunk.t, *triads, least=float(self.rest))

    def simulated(self, channel: str, values: Array, rng: np.random.Generator) -> Sequence[Chunk]:
        """Return a unit that is turned through 20 placements."""
        up = rng.normal(size=(20, 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        dt, hold = 0.02, round((float(self.rest) + 2.0) / 0.02)
        rates, forces = [np.zeros((hold, 3))], [np.tile(up[0], (hold, 1))]
        for a, b in pairwise(up):  # gravity turns from a to b about a x b, the unit the other way round
            about, angle, share = np.cross(a, b), np.arccos(a @ b), (np.arange(50) + 0.5)[:, None] / 50
            rates += [np.tile(-about / np.linalg.norm(about) * angle / (50 * dt), (50, 1)), np.zeros((hold, 3))]
            between = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
            forces += [between, np.tile(b, (hold, 1))]
        u, f = np.concatenate(rates), np.concatenate(forces) * (self.gravity or STANDARD_GRAVITY)
        terms, own = values[3:12].reshape(3, 3), u if channel == "gyro" else f
        y = own + own @ terms.T + values[:3] + rng.normal(0, 1e-7, u.shape)
        if channel == "gyro" and len(values) > 12:
            y = y + f @ values[12:].reshape(3, 3).T
        channels = {"gyro": u + rng.normal(0, 1e-7, u.shape), "accel": f + rng.normal(0, 1e-7, u.shape), channel: y}
        return [Chunk(dt * np.arange(1.0, len(u) + 1), {**channels, "temperature": np.full(len(u), 20.0)})]


def _forces(
    recordings: Sequence[Chunk], channel: str, places: Sequence[Sequence[tuple[int, int]]], gravity: float
) -> PlacedForces:
    """Return the mean readings of an accelerometer in ranges of rows of each recording."""
    rows = [(chunk, slice(*ends)) for chunk, own in zip(recordings, places, strict=True) for ends in own]
    y = np.stack([chunk[channel][part].mean(axis=0) for chunk, part in rows])
    T = np.array([chunk["temperature"][part].mean() for chunk, part in rows])
    t = np.array([chunk.t[part].mean() for chunk, part in rows])
    return PlacedForces(y, T, t, gravity, recordings=np.repeat(np.arange(len(places)), list(map(len, places))))


def rests(t: Array, *triads: Array, least: float) -> list[tuple[int, int]]:
    """Return start and stop of the rests in samples t (N,) of triads (N, 3), each at least `least` s long.

    Raises
    ------
    NotAtRest
        If there are fewer than two.
    """
    per = max(round(WINDOW / float(np.median(np.diff(t)))), 2)
    count = len(t) // per
    quiet = np.ones(count, dtype=bool)
    for values in triads:
        cut = values[: count * per].reshape(count, per, 3)
        scatter, level = np.sqrt(cut.var(axis=1).sum(axis=1)), cut.mean(axis=1)
        usual = np.median(np.sort(scatter)[: max(count // 10, 3)])
        move = np.linalg.norm(np.diff(level, axis=0, prepend=level[:1]), axis=1)  # a slow turn scatters little
        quiet &= (scatter < QUIET * usual) & (move < QUIET * usual)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    margin = max(int(EDGE / WINDOW * per), 1)
    pairs = [(a * per + margin, b * per - margin) for a, b in edges.reshape(-1, 2)]
    whole = [(a, b) for a, b in pairs if b > a and t[b - 1] - t[a] >= least]
    if len(whole) < 2:
        raise NotAtRest(
            f"{len(whole)} placements at rest for {least:g} s were found, two at least were expected; leave the unit "
            "alone for longer at each, or set stimulus.rest lower"
        )
    return whole


def placed_rates(chunk: Chunk, places: Sequence[tuple[int, int]]) -> PlacedRates:
    """Return the input of a gyro at rest in `places` and turned between them; raises MissingChannel."""
    if "accel" not in chunk.channels:
        raise MissingChannel(
            "channel 'accel' is needed: a gyro's placements are known by its accelerometers; name it under "
            "source.channels, or use stimulus kind rate_table"
        )
    t, y, T, f = chunk.t, chunk["gyro"], chunk["temperature"], chunk["accel"]
    step = np.diff(t, prepend=2 * t[0] - t[1])
    # between the mean of one rest and that of the next it stands still but for the turn: the bias alone would add up
    between = [slice(a[1], b[0]) for a, b in pairwise(places)]
    force = np.stack([f[a:b].mean(axis=0) for a, b in places])
    up = force / np.linalg.norm(force, axis=1)[:, None]
    rest = np.stack([y[a:b].mean(axis=0) for a, b in places])
    halves = [slice(*ends) for ends in halved(places)]
    still = np.stack([y[part].mean(axis=0) for part in halves])
    T_still, t_still = (np.array([values[part].mean() for part in halves]) for values in (T, t))
    pulled = np.repeat(force, 2, axis=0)
    return PlacedRates(
        rest, up, np.array([T[a:b].mean() for a, b in places]), np.array([t[a:b].mean() for a, b in places]),
        [y[part] for part in between], [step[part] for part in between], force, [f[part] for part in between],
        KnownRates(np.zeros_like(still), still, T_still, t_still, pulled),
    )  # fmt: skip
