"""Choice of the kind of map for a soak: all that are installed, by cross-validation.

A map is fitted on the blocks of a soak (`driftlab.soak.blocks`) without some of its parts, and its error there is
the residual of the blocks. In each part the errors are averaged in ranges of temperature, so that a long stay at one
counts no more than another temperature, and their mean is taken off where the division asks for it. With w_i blocks in
range i of part p, at most as many as usual::

    S_p = sum_i w_i r_i^2,    error^2 = sum_p S_p / sum_p w_p

It holds the sensor's noise too, which is the same for all kinds. Differences between kinds are paired, part by part,
and their standard error is from their scatter over the parts. Of all whose squared error is within one standard error
of the smallest, the simplest is chosen (Breiman et al., Classification and Regression Trees, 1984): that is the price
for having tried many. Simple is what follows the data least, by how far a curve gives way to a known change of the
samples (generalised degrees of freedom; Ye, J. Am. Stat. Assoc. 93 (1998) 120), and networks come last: what is linear
in its coefficients has one best fit.

Division of a soak into parts: samples that follow one another are not independent. A bias that wanders over hours is
the same in a sample and in its neighbours, so a sample drawn at random is predicted by those that it is to judge. Left
out are, of a soak that passes its temperatures more than once, contiguous parts of time: a map learns their
temperatures from another time. The wandering of the bias meanwhile is taken off as one constant a part: it is no
temperature's. Of several recordings each is left out as a whole. Of a soak that passes each temperature once, ranges of
temperature are left out, and nothing is taken off: there the walk of the bias and the shape of the map are the same.

K blocks, P parts, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import cpu_count
from typing import TypeVar

import numpy as np

from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts import FittedMap, NetworkMap, Plugin, ThermalMap
from fusion_core.errors import ConfigError, FusionError
from fusion_core.thermal.sweeps import sweeps_of
from fusion_core.threads import one_thread

ERROR_RANGES = 50  # of temperature, over which the errors of a part are averaged
NEGLIGIBLE = 1e-4  # of the error without a map: less is no difference
PUSH = 0.1  # of the rms of what a map leaves: the known change of the samples
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Tried:
    """One kind with its settings, and how it did."""

    name: str  # as one says it: `polynomial, order 3`
    settings: ThermalMap | None  # None: no map, a constant
    rms: Array  # (d,): left-out error of each axis, in SI; NaN where it failed
    error: float  # over all axes
    sigma: float  # its standard error
    more: float = 0.0  # by how much it is above the smallest
    more_sigma: float = 0.0  # standard error of that difference
    freedom: float | None = None  # degrees of freedom of its curve, where they decided
    fitted: FittedMap | None = None  # on all blocks
    left: Array | None = None  # (K, d): left-out errors of the blocks, levels taken off; NaN where they are not scored
    failed: str = ""  # why it could not be fitted; empty where it could


@dataclass(frozen=True, eq=False)
class KindComparison:
    """Kinds tried on blocks T (K,), bias (K, d), the chosen one, the one with the smallest error, and no map."""

    tried: tuple[Tried, ...]
    chosen: Tried
    best: Tried
    without: Tried
    division: Division
    T: Array
    bias: Array


@dataclass(frozen=True, eq=False)
class ErrorScale:
    """Weighting of the errors of blocks: `cell` (K,), -1 where not scored, and `weight`, `part` of each cell."""

    cell: Integers
    weight: Array
    part: Integers
    division: Division

    @classmethod
    def of(cls, T: Array, division: Division) -> ErrorScale:
        """Return the cells of blocks: a range of temperature in a part."""
        at = np.minimum(((T - T.min()) * (ERROR_RANGES / np.ptp(T))).astype(np.int64), ERROR_RANGES - 1)
        keys, inverse, count = np.unique(
            (division.part * ERROR_RANGES + at)[division.scored], return_inverse=True, return_counts=True
        )
        cell = np.full(len(T), -1)
        cell[division.scored] = inverse
        return cls(cell, np.minimum(count, np.median(count)), keys // ERROR_RANGES, division)

    def means(self, left: Array) -> Array:
        """Return the means (cells, d) of the residuals of the blocks (K, d)."""
        inside = self.cell >= 0
        count = np.bincount(self.cell[inside])
        return np.stack([np.bincount(self.cell[inside], column[inside]) / count for column in left.T], axis=1)

    def levelled(self, left: Array) -> Array:
        """Return residuals (K, d) without the constants of the levels, NaN where they are not scored."""
        scored = np.where(self.division.scored[:, None], left, np.nan)
        if not self.division.levels:
            return scored
        cells = self.means(left)
        level_of_cell = np.zeros(len(cells), dtype=np.int64)
        level_of_cell[self.cell[self.cell >= 0]] = self.division.level[self.cell >= 0]
        for level in np.unique(level_of_cell):
            own = level_of_cell == level
            scored[self.division.level == level] -= np.average(cells[own], axis=0, weights=self.weight[own])
        return scored

    def squares(self, left: Array) -> tuple[Array, Array]:
        """Return S (P, d) of the parts and their weight (P,)."""
        numbers, index = np.unique(self.part, return_inverse=True)
        S = [np.bincount(index, self.weight * column**2, len(numbers)) for column in self.means(left).T]
        return np.stack(S, axis=1), np.bincount(index, self.weight, len(numbers)).astype(np.float64)


def candidates(named: Sequence[ThermalMap], classes: Iterable[type[Plugin]]) -> list[ThermalMap | str]:
    """Return settings of every kind to try, simplest first within a kind; an error's text where a kind has none.

    A kind that the config names has the config's settings, any other its defaults.
    """
    to_try: list[ThermalMap | str] = []
    for cls in classes:
        kind = str(cls.model_fields["kind"].default)
        try:
            own = next((settings for settings in named if settings.kind == kind), None)
            settings = own or cls.model_validate({"kind": kind})
            assert isinstance(settings, ThermalMap)
            to_try += settings.variants()
        except (FusionError, ValueError) as error:
            to_try.append(f"{kind}: {' '.join(str(error).split())}")
    return to_try


Job = TypeVar("Job")
Fit = TypeVar("Fit")


def side_by_side(fit: Callable[[Job], Fit], jobs: Sequence[Job], progress: Progress | None) -> list[Fit]:
    """Return the fits of all jobs, several at once; `progress` is called with the fits done, and their number."""
    fits = []
    # the matrices are too small to be divided among cores: a fit a core is faster
    with one_thread(), ThreadPoolExecutor(min(4, cpu_count() or 1)) as pool:
        for done, fitted in enumerate(pool.map(fit, jobs), start=1):
            fits.append(fitted)
            if progress is not None:
                progress(done, len(jobs))
    return fits


def compare(
    tried: Sequence[ThermalMap | str], T: Array, bias: Array, division: Division, progress: Progress | None = None
) -> KindComparison:
    """Cross-validate every kind on blocks T (K,), bias (K, d), and choose one.

    `progress`, where given, is called with the fits done, and their number.

    Raises
    ------
    ConfigError
        If no kind can be fitted.
    """
    scale, folds = ErrorScale.of(T, division), [k for k in np.unique(division.fold) if k >= 0]
    settings = [one for one in tried if isinstance(one, ThermalMap)]
    # networks first: they take longest
    jobs = [
        (one, fold)
        for one in sorted(settings, key=lambda one: not isinstance(one, NetworkMap))
        for fold in [*folds, None]
    ]
    fits: dict[int, dict[int | None, FittedMap | str]] = {id(one): {} for one in settings}

    def fit(job: tuple[ThermalMap, int | None]) -> FittedMap | str:
        inside = slice(None) if job[1] is None else division.fold != job[1]
        try:
            return job[0].model_copy(update={"outside": "clamp"}).fit(T[inside], bias[inside], {})
        except FusionError as error:
            return str(error) if job[1] is None else f"with a part left out, {error}"

    for (one, fold), fitted in zip(jobs, side_by_side(fit, jobs, progress), strict=True):
        fits[id(one)][fold] = fitted
    rows = [
        _row(name, one, fits.get(id(one), {}), T, bias, scale) for name, one in zip(names_of(tried), tried, strict=True)
    ]
    return _chosen(rows, T, bias, scale)


def names_of(tried: Sequence[ThermalMap | str]) -> list[str]:
    """Return the names of settings: the kind, and the fields in which they differ from others of the kind."""
    names = []
    for one in tried:
        if isinstance(one, str):
            names.append(one.partition(":")[0])
            continue
        others = [other for other in tried if type(other) is type(one)]
        fields = [key for key in type(one).model_fields if len({repr(getattr(o, key)) for o in others}) > 1]
        names.append(", ".join([one.kind, *(f"{key} {getattr(one, key)}" for key in fields)]))
    return names


def _row(
    name: str, one: ThermalMap | str, fits: dict[int | None, FittedMap | str], T: Array, bias: Array, scale: ErrorScale
) -> Tried:
    settings, failed = (None, one) if isinstance(one, str) else (one, "")
    failed = failed or next((fit for fit in fits.values() if isinstance(fit, str)), "")
    left = np.zeros_like(bias)
    try:
        for fold, fitted in fits.items():
            if fold is not None and isinstance(fitted, FittedMap) and not failed:
                out = scale.division.fold == fold
                left[out] = bias[out] - fitted.bias(T[out])
    except FusionError as error:
        failed = str(error)
    if failed:
        return Tried(name, settings, np.full(bias.shape[1], np.nan), np.nan, np.nan, failed=failed)
    whole = fits[None]
    assert isinstance(whole, FittedMap)
    return _scored(name, settings, whole, scale.levelled(left), scale)


def _scored(name: str, settings: ThermalMap | None, fitted: FittedMap | None, left: Array, scale: ErrorScale) -> Tried:
    S, w = scale.squares(left)
    squares = S.sum(axis=0) / w.sum()
    error = float(np.sqrt(np.mean(squares)))
    sigma = _spread(S.mean(axis=1), w) / (2 * error or 1.0)
    return Tried(name, settings, np.sqrt(squares), error, sigma, fitted=fitted, left=left)


def _spread(S: Array, w: Array) -> float:
    """Return the standard error of sum S / sum w, from the scatter of S (P,) over the parts."""
    P = len(S)
    left = S - w * (S.sum() / w.sum())
    return float(np.sqrt(P / max(P - 1, 1) * np.sum(left**2)) / w.sum())


def _chosen(rows: list[Tried], T: Array, bias: Array, scale: ErrorScale) -> KindComparison:
    good = [row for row in rows if not row.failed]
    if not good:
        raise ConfigError(f"--compare: no kind of map can be fitted to these samples; {rows[0].failed}")
    best = min(good, key=lambda row: row.error)
    assert best.left is not None
    S_best, w = scale.squares(best.left)
    without = _scored("no map", None, None, scale.levelled(bias - bias.mean(axis=0)), scale)
    as_good: list[Tried] = []
    for k, row in enumerate(rows):
        if row.failed or row.left is None:
            continue
        D = (scale.squares(row.left)[0] - S_best).mean(axis=1)
        excess, sigma = float(D.sum() / w.sum()), _spread(D, w)
        rows[k] = replace(row, more=row.error - best.error, more_sigma=sigma / ((row.error + best.error) or 1.0))
        if excess <= sigma or row.error <= best.error + NEGLIGIBLE * without.error:
            as_good.append(rows[k])
    simplest = {row.settings.kind: row for row in reversed(as_good) if row.settings is not None}
    known = {kind: replace(row, freedom=_freedom(row, T, bias)) for kind, row in simplest.items()}
    rows = [next((own for kind, own in known.items() if simplest[kind] is row), row) for row in rows]
    chosen = min(known.values(), key=lambda row: (isinstance(row.settings, NetworkMap), row.freedom))
    best = next(row for row in rows if row.name == best.name)
    return KindComparison(tuple(rows), chosen, best, without, scale.division, T, bias)


def _freedom(row: Tried, T: Array, bias: Array) -> float:
    """Return the degrees of freedom of a curve, from how it answers to a change of the samples; the same for all."""
    assert row.settings is not None
    assert row.fitted is not None
    push = np.random.default_rng(0).choice([-1.0, 1.0], bias.shape)
    size = PUSH * np.sqrt(np.mean((bias - row.fitted.bias(T)) ** 2, axis=0))
    answer = row.settings.fit(T, bias + size * push, {}).bias(T) - row.fitted.bias(T)
    return float(np.mean(np.sum(push * answer, axis=0) / np.where(size > 0, size, 1.0)))


PARTS = 10  # of time, about
SWEEPS = 6  # with that many, each is a part
TURN = 0.25  # of the range: a smaller way back is no turn
FOLD_RANGES, FOLDS = 25, 5  # of temperature, where each is passed once
NEAR = 0.025  # of the range: what is further from any other sample is not scored
MIN_SHARE = 0.5  # of the blocks to be scored


@dataclass(frozen=True, eq=False)
class Division:
    """Division of K blocks for cross-validation."""

    fold: Integers  # (K,): number of the fold: its blocks are left out together; -1: never
    part: Integers  # (K,): number of the part: its errors stand for one another
    scored: Flags  # (K,): blocks whose temperature is also among those that were not left out with them
    levels: bool  # whether a constant is taken off each level
    level: Integers  # (K,): number of the level: its blocks share a constant
    what: str  # the parts, in words

    @property
    def share(self) -> float:
        """Share of the blocks that is scored."""
        return float(np.mean(self.scored))


def divide(recordings: Sequence[Array]) -> Division:
    """Return the division of recordings, of which T (K_r,) are the blocks in the order of time."""
    T = np.concatenate(recordings)
    sizes = np.array([len(own) for own in recordings])
    recording = np.repeat(np.arange(len(sizes)), sizes)
    sweeps = _numbered([sweeps_of(own, TURN * np.ptp(T)) for own in recordings])
    pieces = _pieces(sweeps)
    if len(recordings) > 1:
        by_recording = _division(T, recording, pieces, recording, f"each of {len(recordings)} recordings")
        if by_recording.share >= MIN_SHARE:
            return by_recording
    count = int(sweeps[-1]) + 1
    passes = f"{count} sweep" + "s" * (count > 1)
    what = f"each of {passes}" if count >= SWEEPS else f"{pieces[-1] + 1} parts of time of {passes}"
    by_time = _division(T, pieces, pieces, pieces, what)
    return by_time if by_time.share >= MIN_SHARE else _ranges(T)


def _pieces(sweeps: Integers) -> Integers:
    """Cut sweeps into about `PARTS` contiguous pieces of equal length, or leave them whole where there are many."""
    lengths = np.bincount(sweeps)
    if len(lengths) >= SWEEPS:
        return sweeps
    counts = np.maximum(np.rint(PARTS * lengths / len(sweeps)), 1).astype(np.int64)
    return _numbered([np.arange(n) * count // n for n, count in zip(lengths, counts, strict=True)])


def _ranges(T: Array) -> Division:
    """Leave out every `FOLDS`th range of temperature, but neither end."""
    cell = np.minimum(((T - T.min()) * (FOLD_RANGES / np.ptp(T))).astype(np.int64), FOLD_RANGES - 1)
    fold = np.where((cell == 0) | (cell == FOLD_RANGES - 1), -1, cell % FOLDS)
    what = f"every {FOLDS}th of {FOLD_RANGES} ranges of temperature"
    return _division(T, fold, cell, np.zeros_like(cell), what, levels=False)


def _division(T: Array, fold: Integers, part: Integers, level: Integers, what: str, *, levels: bool = True) -> Division:
    scored = np.zeros(len(T), dtype=np.bool_)
    for k in range(int(fold.max()) + 1):
        out, others = fold == k, np.sort(T[fold != k])
        if not len(others):
            continue
        at = np.searchsorted(others, T[out])
        inside = (at > 0) & (at < len(others))
        near = np.minimum(
            np.abs(T[out] - others[np.maximum(at - 1, 0)]), np.abs(others[np.minimum(at, len(others) - 1)] - T[out])
        )
        scored[out] = (inside | (near == 0)) & (near <= NEAR * np.ptp(T))
    return Division(fold, part, scored, levels, level, what)


def _numbered(parts: Sequence[Integers]) -> Integers:
    """Join numbers that each begin at zero to numbers that go on."""
    joined: list[Integers] = []
    for own in parts:
        joined.append(own + (joined[-1][-1] + 1 if joined else 0))
    return np.concatenate(joined)
