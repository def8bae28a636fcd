"""Unsteady noise, whose mean square is known less well than that of Gaussian noise of one strength.

White noise e of any law has the Allan variance E e^2 dt / tau, and the squares of its samples enter that of every
averaging time alike. So where these scatter more than Gaussian ones, or together, the whole curve lies too high or too
low by one factor, however well it follows the five terms. The factor is seen in the mean squares M_b of the second
differences in B equal parts of the recording::

    s^2 = B / (B - 1) sum of w_b^2 (M_b / M - 1)^2,       w_b the part of the differences,  M their mean square

is the relative variance of M where the parts are independent; the spectrum of the fit says what it would be of Gaussian
noise: slow noise, whose squares are alike in neighbouring samples, is in that. With BATCHES parts, bursts of up to a
tenth of the recording are within one of them.

(M - true) / (s M) has Student's law where the squares have a variance. Where their tail falls as x^-alpha with
alpha < 2, as those of Student's t with 3 degrees of freedom, sums of them tend to a stable law of index alpha, and the
mean is mostly too low: the law is that of so many stable variates. alpha is read from the largest squares; since it is
known badly, the wider of the two laws counts on each side.

Sources: B. M. Hill, Ann. Stat. 3 (1975) 1163; B. F. Logan, C. L. Mallows, S. O. Rice and L. A. Shepp, Limit
distributions of self-normalized sums, Ann. Prob. 1 (1973) 788; J. P. Romano and M. Wolf, Metrika 50 (1999) 55.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusion_core.chunk import Array, Integers

PARTS = 256  # of a recording, whose mean squares are kept: many, to see that they scatter
BATCHES = 16  # of them that are taken for independent
COUNTS = (BATCHES, 32, 64, 128, PARTS)  # into which the recording is cut, to see that they scatter
LEAST = 32  # averaging times in a part; where it has fewer, its neighbours have part of its differences
FORETOLD = 1.12  # times the scatter that the model foretells, which steady noise may have: walks that are averaged
CHANCE = 1e-4  # that a steady noise is taken for one that is not, by one of COUNTS
HEAVIEST = 1.25  # index of a tail; below, the largest square alone is as large as the others together
DRAWS = 400  # curves that are drawn under one trial value
VARIATES = 2**13  # by which a law is known


@dataclass(frozen=True)
class Unsteady:
    """Scatter of unsteady noise beyond that of Gaussian noise of one strength.

    `part` (4,) says how much of it each term but the ramp has, `together` (J,) is the covariance of the mean squares of
    neighbouring stretches of an averaging time, relative: the noise within one scatters by so much more.
    """

    scatter: float  # relative standard deviation of the mean square that is added
    times: float  # ratio of the whole deviation to that of Gaussian noise
    part: Array
    together: Array
    index: float  # of the tail of the squares, 2 where they have a variance

    @cached_property
    def factors(self) -> Array:
        """Factors (DRAWS,) of the mean squares that such a recording may have, to the true one.

        They are such that the limits of an estimate are where (estimate - true) / (scatter estimate) has those of T,
        the mean of BATCHES variates over its deviation; upwards in logarithms, since no mean square is below zero.
        """
        laws = np.sort([_ratios(self.index), _ratios(2.0)], axis=0)
        middle = DRAWS // 2
        T = np.concatenate([np.min(laws[:, :middle], axis=0), np.max(laws[:, middle:], axis=0)]) * self.scatter
        return np.random.default_rng(1).permutation(np.where(T > 0, np.exp(T), 1 / (1 - np.minimum(T, 0))))

    def scattered(self, noise: Array, mean: Array, share: Array) -> Array:
        """Return variances (J, DRAWS) of this mean (J, 1), drawn as steady, where a share (J, 1) of them is not."""
        within = (noise - mean) * np.sqrt(1 + share**2 * self.together[-len(mean) :, None])
        return np.asarray(np.maximum(mean + within, 0.01 * mean) * (1 + share * (self.factors - 1)))

    @property
    def note(self) -> str:
        """Sentence for the user."""
        return (
            "single samples stand out, or the noise is stronger at some times than at others: the mean squares of "
            f"equal parts of the recording scatter {self.times:.2g} times as much as those of steady Gaussian noise, "
            "and the limits are widened by as much; look at the samples for spikes, bursts, and hours that differ"
        )


def tail(rate: Array, stretches: Integers) -> float:
    """Return the index of the tail of squared differences of neighbouring samples, from HEAVIEST to 2, by Hill.

    It is that of the noise, whatever filter the samples went through.
    """
    squares = np.diff(rate)
    squares[stretches[1:, 0] - 1] = 0.0
    squares = squares[::2] ** 2
    k = int(len(squares) ** (2 / 3))
    above = squares[squares > np.mean(squares)] - np.mean(squares)
    if k >= len(above):
        return 2.0
    top = np.partition(above, len(above) - k - 1)[-k - 1 :]
    mean = float(np.mean(np.log(top / np.min(top)))) * (k + 1) / k
    return min(max(1 / mean, HEAVIEST), 2.0) if mean > 0 else 2.0


def unsteady_of(parts: Array, m: Array, first: int, steady: tuple[float, Array, float]) -> Unsteady | None:
    """Return the unsteady part of noise; None where there surely is none.

    Parameters
    ----------
    parts : (PARTS, 2) array
        Sum of the squares of the differences over averaging time number `first` in each part, and their number.
    m : (J,) array
        Averaging times in those differences.
    steady : (float, (4,) array, float)
        Relative standard deviation of the mean square of Gaussian noise; `part` of `Unsteady`; `tail`.
    """
    spread, part, index = steady
    total = float(np.sum(parts[:, 1]))
    counts = [count for count in COUNTS if count * LEAST * m[first] <= total]
    each = [parts.reshape(count, -1, 2).sum(axis=1) for count in counts]
    found = [_variance(one) for one in each]
    most = [_most(count, FORETOLD * spread) for count in counts]
    scatter = float(np.sqrt(max(max(found, default=0.0) - spread**2, 0.0)))
    if scatter == 0 or not any(one > limit for one, limit in zip(found, most, strict=True)):
        return None
    alike = np.array([_alike(one) for one in each])
    # parts of at least an averaging time: as many as there are such
    which = np.searchsorted(counts, total / m, side="right") - 1
    together = alike[np.maximum(which, 0)]
    return Unsteady(scatter, float(np.sqrt(max(found)) / spread), part, together, index)


def _off(parts: Array) -> Array:
    """Return w (M_b / M - 1) of each part (B,)."""
    total = np.sum(parts, axis=0)
    return np.asarray(parts[:, 0] / total[0] - parts[:, 1] / total[1])


def _variance(parts: Array) -> float:
    """Return the relative variance of the mean square, by that of parts (B, 2) of it."""
    off = _off(parts[parts[:, 1] > 0])
    return float(np.sum(off**2)) * len(off) / max(1, len(off) - 1)


def _alike(parts: Array) -> float:
    """Return the relative covariance of mean squares of neighbouring parts (B, 2), 0 where it is less."""
    off = _off(parts)
    return max(0.0, float(off[1:] @ off[:-1]) * len(off))


def _most(count: int, spread: float) -> float:
    """Return the variance that so many parts of Gaussian noise exceed by CHANCE: gamma variates, each of them."""
    from scipy.special import gammainccinv

    degrees = (count - 1) / (1 + 3 * count * spread**2)
    return float(spread**2 * gammainccinv(degrees / 2, CHANCE) * 2 / degrees)


def _ratios(index: float) -> Array:
    """Return quantiles (DRAWS,) of the mean of BATCHES variates of a stable law, over its deviation by themselves."""
    from scipy.stats import levy_stable

    x = levy_stable.rvs(index, 1.0, size=(BATCHES, VARIATES), random_state=np.random.default_rng(1963))
    ratios = np.mean(x, axis=0) / (np.std(x, axis=0, ddof=1) / np.sqrt(BATCHES))
    return np.asarray(np.quantile(ratios, (np.arange(DRAWS) + 0.5) / DRAWS))
