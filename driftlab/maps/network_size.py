"""Number of neurons that a network needs: the selection of section 5 of the paper, on one soak.

The samples are drawn at random into 65 % for training, 20 % for validation and 15 % for testing. For each size n one
network of the bias and one of its derivative (`target: slope`) are fitted on the first part. Then, eq. (12):

::

    Sr(n) = sqrt(res_x^2 + res_y^2 + res_z^2)

    bias:   res_a^2 = sum_j N_j r_j^2 / sum_j N_j
    slope:  res_a^2 = sum_j w_j q_j^2 / sum_j w_j,  q_j = (r_{j+1} - r_j) / (T_{j+1} - T_j),  1/w_j = Var(q_j) / sigma^2

r_j is the mean of (measured bias - b(T)) over the N_j samples of bin j, one of 50 equal ranges of temperature; q_j is
the data's difference quotient less the mean slope of the map between the same samples, so no quotient is taken for a
derivative. Over single samples, sensor noise would hide the map's error in both; over the bins it is down to `noise`.

The smallest n is chosen whose validation Sr is within two standard errors of the best one: what 50 bins cannot tell
apart is not worth more neurons. (After the one-standard-error rule of Breiman et al., Classification and Regression
Trees, 1984; two, since the best of ten is chosen by its luck too.) Where there is no noise, a thousandth of the Sr
of no map at all is enough. Since all parts are of one soak, an error that comes back at the same temperatures, such
as a slow drift, is in all three: only another recording shows it. Source: Fontanella et al., Sensors 18 (2018) 1457.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from driftlab.maps.kind_selection import Progress, side_by_side
from fusion_core.chunk import Array, Integers
from fusion_core.contracts import FittedMap, NetworkMap, Target, ThermalMap
from fusion_core.errors import ConfigError, EmptyRecording, SwingTooSmall

Key = tuple[Target, int]  # and the neurons

PARTS = {"training": 0.65, "validation": 0.20, "test": 0.15}
BINS = 50  # of the temperatures of the soak
MIN_SAMPLES = 200  # to divide
NEGLIGIBLE = 1e-3  # of the Sr without a map


@dataclass(frozen=True, eq=False)
class Convergence:
    """Sr against n for the networks of one target: figure 7 (bias, SI) or 8 (slope, SI/K) of the paper."""

    target: Target
    neurons: tuple[int, ...]
    Sr: Array  # (sizes, 3): on the training, validation and test part
    noise: Array  # (3,): Sr of the sensor's noise alone
    limit: float  # largest validation Sr that is enough
    chosen: int  # smallest n within the limit


@dataclass(frozen=True, eq=False)
class Selection:
    """The networks that were tried, and the choice; the last three are rms over the test part (d,), in SI/K."""

    bias: Convergence
    slope: Convergence
    analytic: Array  # (sizes, 3): Sr of the derivative, of the analytic slope of the bias networks
    samples: tuple[int, ...]  # of each part
    seed: int
    slope_network: Array  # (d,): chosen derivative network less the data's derivative
    analytic_slope: Array  # (d,): analytic slope of the chosen bias network less the data's derivative
    between: Array  # (d,): one less the other

    def of(self, target: Target) -> Convergence:
        """Return the convergence of a target."""
        return self.bias if target == "bias" else self.slope


@dataclass(frozen=True, eq=False)
class BinnedPart:
    """One part of the samples, and the bin of each: T (N,), bias (N, d), bin (N,)."""

    T: Array
    bias: Array
    bin: Integers

    def residual(self, fitted: FittedMap | None) -> BinResidual:
        """Return the means of a map's residual; None is a constant."""
        left = self.bias - (self.bias.mean(axis=0) if fitted is None else fitted.bias(self.T))
        count = np.bincount(self.bin, minlength=BINS)
        full = count > 0
        N = count[full].astype(np.float64)
        r = np.stack([np.bincount(self.bin, column, BINS)[full] / N for column in left.T], axis=1)
        squares = np.sum(left**2, axis=0) - N @ r**2
        sigma = np.sqrt(np.maximum(squares, 0.0) / max(len(left) - len(N), 1))
        return BinResidual(np.bincount(self.bin, self.T, BINS)[full] / N, r, N, sigma)


@dataclass(frozen=True, eq=False)
class BinResidual:
    """Residual in the bins: mean T (m,), mean residual r (m, d), samples N (m,), sigma (d,) of one sample."""

    T: Array
    r: Array
    N: Array
    sigma: Array

    def of(self, target: Target) -> tuple[Array, Array]:
        """Return values (m, d) or (m - 1, d) and their weights: the residual, or its difference quotients."""
        if target == "bias":
            return self.r, self.N
        step = np.diff(self.T)
        return np.diff(self.r, axis=0) / step[:, None], step**2 / (1 / self.N[1:] + 1 / self.N[:-1])

    def res(self, target: Target) -> Array:
        """Return the weighted rms (d,)."""
        values, w = self.of(target)
        return np.asarray(np.sqrt(w @ values**2 / w.sum()), dtype=np.float64)

    def Sr(self, target: Target) -> float:
        """Return eq. (12)."""
        return float(np.linalg.norm(self.res(target)))

    def error(self, target: Target) -> float:
        """Return the standard error of Sr, from the scatter of the squares."""
        values, w = self.of(target)
        p = w / w.sum()
        spread = np.sqrt(np.sum((p[:, None] * (values**2 - p @ values**2)) ** 2))
        return float(spread / (2 * self.Sr(target) or 1.0))

    def noise(self, target: Target) -> float:
        """Return the Sr that is expected of the sensor's noise alone."""
        _, w = self.of(target)
        return float(np.sqrt(len(w) / w.sum()) * np.linalg.norm(self.sigma))


def split(N: int, seed: int) -> list[Integers]:
    """Return the indices of the samples of each part, in ascending order; together they are all of N."""
    cuts = np.round(np.cumsum(list(PARTS.values()))[:-1] * N).astype(int)
    return [np.sort(part) for part in np.split(np.random.default_rng(seed).permutation(N), cuts)]


def select(
    settings: ThermalMap,
    T: Array,
    bias: Array,
    neurons: Iterable[int] = range(1, 11),
    seed: int = 0,
    progress: Progress | None = None,
) -> Selection:
    """Find how many neurons a network needs, for the bias and for its derivative.

    The soak is T (N,) in degC and bias (N, d) in SI. All but size and target is taken from the settings; sizes are
    tried in ascending order until the temperatures do not determine so many weights. `seed` is of the division into
    parts; `progress` is called with the networks done, and their number.

    Raises
    ------
    ConfigError
        If the map is no network, or there is no size to try.
    DataError
        If the soak cannot be divided, or does not determine the smallest network.
    """
    network, sizes = check_selection(settings, neurons)
    if len(T) < MIN_SAMPLES:
        raise EmptyRecording(f"selection: has {len(T)} samples, expected at least {MIN_SAMPLES}; use a longer soak")
    bins = np.minimum(((T - T.min()) * (BINS / (np.ptp(T) or 1.0))).astype(np.intp), BINS - 1)
    parts = [BinnedPart(T[k], bias[k], bins[k]) for k in split(len(T), seed)]
    maps = _fit_all(network, sizes, parts[0], progress)
    return _compare(maps, parts, seed)


def _compare(maps: dict[Key, FittedMap], parts: list[BinnedPart], seed: int) -> Selection:
    sizes = tuple(sorted({n for _, n in maps if ("bias", n) in maps and ("slope", n) in maps}))
    left = {key: [part.residual(fitted) for part in parts] for key, fitted in maps.items()}
    of_bias, of_slope = (_convergence(target, sizes, left, parts[1].residual(None)) for target in ("bias", "slope"))
    network: Key = ("slope", of_slope.chosen)
    ours: Key = ("bias", of_bias.chosen)
    T = parts[2].T
    return Selection(
        of_bias,
        of_slope,
        np.array([[residual.Sr("slope") for residual in left["bias", n]] for n in sizes]),
        tuple(len(part.T) for part in parts),
        seed,
        left[network][2].res("slope"),
        left[ours][2].res("slope"),
        np.sqrt(np.mean((maps[network].slope(T) - maps[ours].slope(T)) ** 2, axis=0)),
    )


def check_selection(settings: ThermalMap, neurons: Iterable[int]) -> tuple[NetworkMap, tuple[int, ...]]:
    """Return the network and the sizes to try; raises ConfigError where the map is none, or there is no size."""
    sizes = tuple(neurons)
    if not isinstance(settings, NetworkMap):
        raise ConfigError(
            f"--select: kind {settings.kind} is no network, expected one; give --kind onnx_network, or leave --select "
            "out"
        )
    if not sizes or sizes[0] < 1:
        raise ConfigError("--neurons-max: expected at least 1; write e.g. --neurons-max 10")
    return settings, sizes


def _fit_all(
    settings: NetworkMap, sizes: tuple[int, ...], part: BinnedPart, progress: Progress | None
) -> dict[Key, FittedMap]:
    """Fit every size for both targets, side by side; those with more weights than temperatures are left out."""
    targets: tuple[Target, ...] = ("bias", "slope")

    def fit(key: Key) -> FittedMap | None:
        # the parts beyond the training part may be a little wider
        update = {"target": key[0], "neurons": key[1], "outside": "clamp"}
        try:
            return settings.model_copy(update=update).fit(part.T, part.bias, {})
        except SwingTooSmall:
            if key[1] == sizes[0]:
                raise
            return None

    keys = sorted(product(targets, sizes), key=lambda key: -key[1])  # the long ones first
    fits = zip(keys, side_by_side(fit, keys, progress), strict=True)
    return {key: fitted for key, fitted in fits if fitted is not None}


def _convergence(
    target: Target, sizes: tuple[int, ...], left: dict[Key, list[BinResidual]], without: BinResidual
) -> Convergence:
    Sr = np.array([[residual.Sr(target) for residual in left[target, n]] for n in sizes])
    best = int(np.argmin(Sr[:, 1]))
    slack = max(2 * left[target, sizes[best]][1].error(target), NEGLIGIBLE * without.Sr(target))
    limit = float(Sr[best, 1] + slack)
    noise = np.array([residual.noise(target) for residual in left[target, sizes[best]]])
    return Convergence(target, sizes, Sr, noise, limit, sizes[int(np.argmax(Sr[:, 1] <= limit))])


def settings_selected(
    settings: ThermalMap, T: Array, bias: Array, neurons: Iterable[int], progress: Callable[..., None] | None = None
) -> tuple[NetworkMap, Selection, str]:
    """Return the settings with the chosen size for samples, the selection, and its text in a map's provenance.

    `progress`, where given, is called with texts. Raises as `select` does.
    """
    network, sizes = check_selection(settings, neurons)

    def report(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} networks trained")

    report(0, 2 * len(sizes))
    selection = select(network, T, bias, sizes, progress=report)
    chosen = selection.of(network.target).chosen
    tried = f"{chosen} neurons of {selection.bias.neurons[0]} to {selection.bias.neurons[-1]}"
    return network.model_copy(update={"neurons": chosen}), selection, tried
