"""One soak of a three-axis sensor with a memory of a known shape and size: in plain NumPy, no code of the project.

    bias = level + curve(T) + memory(history of T) + drift t + noise      [rad/s]

T is a body of some minutes behind its chamber. The size of a memory is the greatest difference between warming and
cooling at the same temperature in this soak (`opening`). `truth_gain` is what the likelihood that knows the truth
has for it: the log-likelihood [nats] of the true shape, its coefficient unknown on each axis, three axes together,
over none, beside a free curve of T, a level and a drift, under the noise that made the soak.
Sigmas and sizes are in rad/s: write `24 * DEG_H`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from foreign_curves import draw_curves

DEG_H = np.deg2rad(1 / 3600)  # rad/s
MINUTE = 60.0


@dataclass(frozen=True)
class Noise:
    """White noise and one slow noise of a sensor; two-sided densities."""

    slow: str = "walk"  # walk, flicker, gauss_markov, none
    white: float = 10 * DEG_H  # rad/s/sqrt(Hz)
    walk: float = 0.03 * DEG_H  # rad/s/sqrt(s); a Gauss-Markov process starts like this walk
    flicker: float = 2.0 * DEG_H  # B of S(f) = B^2 / (2 pi f) [rad/s]; the Allan deviation's floor is 0.66 B
    tau: float = 3600.0  # s, of the Gauss-Markov process


@dataclass(frozen=True)
class Soak:
    """One soak; N rows of `interval` seconds each, at their middles, d = 3 axes."""

    t: np.ndarray  # (N,) s
    T: np.ndarray  # (N,) degC, as the thermometer says it
    bias: np.ndarray  # (N, 3) rad/s, as the sensor says it
    T_true: np.ndarray  # (N,) degC
    curve: np.ndarray  # (N, 3) rad/s, truth: level and curve
    memory: np.ndarray  # (N, 3) rad/s, truth: what the memory adds to the curve
    size: np.ndarray  # (3,) rad/s, `opening` of the memory
    interval: float  # s
    base: float  # s, step of the simulation: rows are means of interval / base of these
    noise: Noise
    drift: np.ndarray  # (3,) rad/s^2
    name: str = ""  # kind, profile, hours, noise
    parameters: dict[str, float] = field(default_factory=dict)  # half width [K], tau [s] of each kind


# --- temperatures


def _corners(profile: str, seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the chamber's corners: times [s] and temperatures [degC]."""
    low, high = rng.uniform(-25, -15), rng.uniform(45, 55)
    if profile in ("once", "twice", "room"):
        turns = {"once": [low, high, low], "twice": [low, high, low, high, low], "room": [25.0, low, high, low, 25.0]}
        T = np.array(turns[profile])
        length, hold = np.abs(np.diff(T)), rng.uniform(0.02, 0.08)
        times, temps = [0.0], [T[0]]
        for k, part in enumerate(length / length.sum()):
            times += [times[-1] + part * (1 - hold), times[-1] + part]
            temps += [T[k + 1], T[k + 1]]
        return np.array(times) * seconds, np.array(temps)
    if profile == "sines":
        t = np.linspace(0, 1, 2000)
        swing = (high - low) / 2 * np.sin(2 * np.pi * 3 * t + rng.uniform(-np.pi, np.pi))
        return t * seconds, (low + high) / 2 + swing
    if profile == "stairs":
        steps = int(rng.integers(5, 9))
        levels = np.concatenate([np.linspace(low, high, steps), np.linspace(high, low, steps)[1:]])
        each, ramp = 1 / len(levels), rng.uniform(0.1, 0.5) / len(levels)
        times = np.concatenate([[k * each, (k + 1) * each - ramp] for k in range(len(levels))])
        return times * seconds, np.repeat(levels, 2)
    if profile == "ramps":
        count = int(rng.integers(7, 14))
        T = rng.uniform(low, high, count)
        T[rng.permutation(count)[:2]] = low, high  # the range is covered
        length = np.abs(np.diff(T)) / np.exp(rng.uniform(np.log(0.3), np.log(3.0), count - 1))  # at 0.3 to 3 K/min
        length += rng.exponential(0.1 * length.mean(), count - 1)
        return np.concatenate([[0.0], np.cumsum(length) / length.sum()]) * seconds, T
    raise ValueError(f"profile: got {profile!r}, expected one of {PROFILES}")


PROFILES = ("once", "twice", "room", "sines", "stairs", "ramps")


def behind(x: np.ndarray, tau: float, step: float, start: float | None = None) -> np.ndarray:
    """Return x (N,) through a first-order lag of tau [s], sampled each `step` [s]; in equilibrium at the start."""
    from scipy.signal import lfilter

    if tau <= 0:
        return x.copy()
    a = np.exp(-step / tau)
    first = x[0] if start is None else start
    held = np.concatenate([[x[0]], x[:-1]])
    return lfilter([1 - a], [1, -a], held, zi=[a * first])[0]


def temperatures(profile: str, seconds: float, step: float, seed: int, body: float | None = None) -> np.ndarray:
    """Return the true temperature (N,) of a body of 3 to 10 minutes (or `body` [s]) in a chamber."""
    rng = np.random.default_rng([seed, 1])
    times, T = _corners(profile, seconds, rng)
    t = (np.arange(round(seconds / step)) + 0.5) * step
    drawn = rng.uniform(180, 600)
    return behind(np.interp(t, times, T), drawn if body is None else body, step)


# --- memories


def _turns(T: np.ndarray) -> np.ndarray:
    """Return the indices between which T (N,) is monotone, with both ends."""
    way = ways(T)
    return np.concatenate([[0], np.flatnonzero(way[1:] != way[:-1]), [len(T) - 1]])


def ways(T: np.ndarray) -> np.ndarray:
    """Return +1 while warming and -1 while cooling (N,); where T stands, the last way."""
    step = np.sign(np.diff(T, prepend=T[0]))
    moved = np.flatnonzero(step)
    if not len(moved):
        return np.ones_like(T)
    last = np.searchsorted(moved, np.arange(len(T)), side="right") - 1
    return step[moved[np.maximum(last, 0)]]


def play(T: np.ndarray, width: float) -> np.ndarray:
    """Return the play operator of half width `width` [K] over T (N,), starting in the middle of its play."""
    out, p = np.empty_like(T), T[0]
    turns = _turns(T)
    for a, b in itertools.pairwise(turns):
        part = T[a : b + 1]
        out[a : b + 1] = np.maximum(p, part - width) if part[-1] >= part[0] else np.minimum(p, part + width)
        p = out[b]
    return out


def opening(T: np.ndarray, x: np.ndarray, points: int = 400) -> np.ndarray:
    """Return the greatest difference of x (N, d) between warming and cooling at the same T (N,), shape (d,)."""
    grid = np.linspace(T.min(), T.max(), points)
    most, least = np.full((2, 2, points, x.shape[1]), -np.inf)
    turns = _turns(T)
    for a, b in itertools.pairwise(turns):
        way = int(T[b] > T[a])
        order = slice(a, b + 1) if way else slice(b, None if a == 0 else a - 1, -1)
        inside = (grid >= min(T[a], T[b])) & (grid <= max(T[a], T[b]))
        for k in range(x.shape[1]):
            values = np.interp(grid[inside], T[order], x[order, k])
            most[way, inside, k] = np.maximum(most[way, inside, k], values)
            least[way, inside, k] = np.maximum(least[way, inside, k], -values)
    both = np.maximum(most[1] + least[0], most[0] + least[1])
    return np.where(np.isfinite(both), both, 0.0).max(axis=0)


LIMITS = {  # what is drawn, on a logarithm: half widths [K], times [s]
    "play": (1.0, 10.0),
    "preisach": (2.0, 8.0),
    "bent_play": (1.0, 6.0),
    "lag": (60.0, 1800.0),
    "relaxation": (60.0, 1800.0),
    "step": (1.0, 1.0),
    "rate": (1.0, 1.0),
}
MEMORIES = (*LIMITS, "play+relaxation", "play+lag", "play+step", "lag+rate")


def _shape(kind: str, T: np.ndarray, step: float, value: float, curves: list, rng: np.random.Generator) -> np.ndarray:
    """Return one axis-wise shape (N, 3) of unit coefficient: zero where nothing ever moved."""
    if kind == "lag":  # the bias follows the lagged temperature
        late = behind(T, value, step)
        return np.column_stack([c(late) - c(T) for c in curves])
    if kind == "bent_play":
        late = play(T, value)
        return np.column_stack([c(late) - c(T) for c in curves])
    if kind == "play":
        one = play(T, value) - T
    elif kind == "preisach":  # many plays, weights falling over the widths
        widths = value * np.array([0.25, 0.5, 1.0, 1.5, 2.0])
        weights = rng.dirichlet(np.ones(5))
        one = sum(w * (play(T, r) - T) for w, r in zip(weights, widths, strict=True))
    elif kind == "relaxation":
        one = behind(T, value, step) - T
    elif kind == "step":
        one = ways(T)
    elif kind == "rate":
        one = np.gradient(T, step)
    else:
        raise ValueError(f"memory: got {kind!r}, expected one of {tuple(LIMITS)}, or some of them joined by +")
    return np.repeat(one[:, None], 3, axis=1)


# --- noises


def _slow(noise: Noise, count: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """Return three axes of the slow noise (count, 3)."""
    if noise.slow == "walk":
        return np.cumsum(rng.normal(size=(count, 3)) * noise.walk * np.sqrt(step), axis=0)
    if noise.slow == "gauss_markov":
        from scipy.signal import lfilter

        a, sigma = np.exp(-step / noise.tau), noise.walk * np.sqrt(noise.tau / 2)
        driven = rng.normal(size=(count, 3)) * sigma * np.sqrt(1 - a**2)
        driven[0] /= np.sqrt(1 - a**2)
        return lfilter([1.0], [1.0, -a], driven, axis=0)
    if noise.slow == "flicker":
        density = _flicker_density(noise, count, step)
        white = np.fft.rfft(rng.normal(size=(2 * len(density) - 2, 3)), axis=0)
        return np.fft.irfft(white * np.sqrt(density / step)[:, None], axis=0)[:count]
    if noise.slow == "none":
        return np.zeros((count, 3))
    raise ValueError(f"noise: got {noise.slow!r}, expected one of {NOISES}")


NOISES = ("walk", "flicker", "gauss_markov", "none")


def _flicker_density(noise: Noise, count: int, step: float) -> np.ndarray:
    """Return the two-sided density over f, of a period of at least four times the soak."""
    period = 2 ** int(np.ceil(np.log2(4 * count)))
    f = np.fft.rfftfreq(period, step)
    f[0] = f[1]
    return noise.flicker**2 / (2 * np.pi * f)


def block_covariance(noise: Noise, blocks: int, rows: int, step: float) -> np.ndarray:
    """Return the exact covariance (blocks, blocks) of means over `rows` samples of the noise that `draw` makes."""
    lags = np.arange(blocks * rows + rows)
    white = np.eye(blocks) * noise.white**2 / (rows * step)
    if noise.slow == "none":
        return white
    if noise.slow == "walk":
        i = np.arange(blocks)
        C = np.minimum.outer(i, i) * float(rows) + (rows + 1) / 2
        C[i, i] = i * rows + (rows + 1) * (2 * rows + 1) / (6 * rows)
        return white + C * noise.walk**2 * step
    if noise.slow == "gauss_markov":
        gamma = noise.walk**2 * noise.tau / 2 * np.exp(-lags * step / noise.tau)
    else:
        gamma = np.fft.irfft(_flicker_density(noise, blocks * rows, step))[: len(lags)] / step
    weights = np.concatenate([np.arange(1, rows + 1), np.arange(rows - 1, 0, -1)]) / rows**2
    near = np.concatenate([gamma[rows - 1 : 0 : -1], gamma])
    means = np.convolve(near, weights, mode="valid")[::rows][:blocks]
    return white + means[np.abs(np.subtract.outer(np.arange(blocks), np.arange(blocks)))]


# --- the soak


def draw(
    seed: int,
    profile: str = "room",
    hours: float = 6.0,
    noise: str | Noise = "walk",
    memory: str = "none",
    size: float | tuple[float, float, float] | np.ndarray = 0.0,
    *,
    value: float | None = None,
    interval: float = 1.0,
    amplitude: float = 300 * DEG_H,
    drift: float = 0.3 * DEG_H / 3600,
    resolution: float = 0.01,
    thermometer: float = 0.01,
    body: float | None = None,
) -> Soak:
    """Draw one soak.

    Parameters
    ----------
    seed : int
        Same arguments, same soak; `profile`, curves and noises of a seed do not depend on the memory.
    profile : str
        One of `PROFILES`; "room" is 25, low, high, low, 25 degC.
    hours : float
        How long.
    noise : str or Noise
        One of `NOISES`, or with densities of your own.
    memory : str
        "none", one of `LIMITS`, or several joined by "+" (then each opens as far as the others).
    size : float or (3,)
        Greatest difference between warming and cooling at the same temperature [rad/s], with a sign for each axis;
        one number is x: y has minus two thirds of it and z none.
    value : float, optional
        Half width [K] or time constant [s] of the memory; drawn where None (of several kinds: of the first).
    interval : float
        Seconds of a row: a mean of the samples at 1 Hz, or below 1 s the samples themselves.
    amplitude : float
        Greatest less least of the curve over -20 to 50 degC [rad/s]. The curve of an axis whose whole curve lags
        ("lag", "bent_play") is instead as large as makes its memory of the size asked for.
    drift : float
        Standard deviation of a straight line over time [rad/s^2].
    resolution, thermometer : float
        Steps of the thermometer [K], and its white noise at each sample before rounding [K].
    body : float, optional
        Time constant of the body [s]; drawn from 180 to 600 where None.

    Returns
    -------
    Soak
    """
    base = min(1.0, interval)
    law = Noise(slow=noise) if isinstance(noise, str) else noise
    T = temperatures(profile, hours * 3600, base, seed, body)
    lines = draw_curves(seed, amplitude)
    curve = np.column_stack([c(T) for c in lines])
    sizes = np.array([1.0, -2 / 3, 0.0]) * size if np.ndim(size) == 0 else np.asarray(size, float)
    follows, hidden, values = _memory(memory, sizes, T, base, seed, value)
    whole = (sizes != 0) & (memory in ("lag", "bent_play"))  # axes whose whole curve follows
    curve = np.where(whole, 0.0, curve) + follows
    rng = np.random.default_rng([seed, 4])
    level, slope = rng.normal(size=(2, 3)) * [[amplitude], [drift]]
    curve = curve + level
    t = (np.arange(len(T)) + 0.5) * base
    shaky = rng.normal(size=(len(T), 3)) * law.white / np.sqrt(base) + _slow(law, len(T), base, rng)
    seen = T + np.random.default_rng([seed, 5]).normal(size=len(T)) * thermometer
    if resolution > 0:
        seen = np.round(seen / resolution) * resolution
    rows = max(round(interval / base), 1)
    columns = [t, seen, curve + hidden + slope * (t - t.mean())[:, None] + shaky, T, curve, hidden]
    means = [_means(c, rows) for c in columns]
    name = f"{memory}, {profile}, {hours:g} h, {law.slow}"
    return Soak(*means, opening(T, hidden), interval, base, law, slope, name, values)


def _memory(
    memory: str, sizes: np.ndarray, T: np.ndarray, step: float, seed: int, value: float | None
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Return the curve that follows a late temperature, the memory (both (N, 3)), and widths or times by kind."""
    rng = np.random.default_rng([seed, 3])
    curve, total, values = np.zeros((len(T), 3)), np.zeros((len(T), 3)), {}
    for k, kind in enumerate([] if memory == "none" else memory.split("+")):
        if kind not in LIMITS:
            raise ValueError(f"memory: got {kind!r}, expected one of {tuple(LIMITS)}, or some of them joined by +")
        values[kind] = value if value and not k else float(np.exp(rng.uniform(*np.log(LIMITS[kind]))))
        own = draw_curves(seed + 7919, 1.0)
        one = _shape(kind, T, step, values[kind], own, rng)
        size = opening(T, one)
        if not size.all():
            raise ValueError(f"{kind}: warming and cooling do not differ in this profile")
        total += one / size
        if kind in ("lag", "bent_play"):
            curve += np.column_stack([c(T) for c in own]) / size
    scale = np.zeros(3) if memory == "none" else sizes / opening(T, total)
    return curve * scale, total * scale, values


def _means(x: np.ndarray, rows: int) -> np.ndarray:
    count = len(x) // rows
    return x[: count * rows].reshape(count, rows, *x.shape[1:]).mean(axis=1) if rows > 1 else x


# --- the likelihood that knows the truth


def truth_gain(soak: Soak, piece: float = 5.0, *, fitted: bool = False) -> float:
    """Return the log-likelihood gain [nats] of the true memory's shape over none, three axes together.

    Parameters
    ----------
    soak : Soak
        As drawn, with its truth. Nothing planted: 0.
    piece : float
        Kelvin between the knots of the free curve, a cubic B-spline.
    fitted : bool
        The noise's law and size, and the share of its slow part, are not known but as likely as can be under each
        hypothesis: less than with the true noise, much less where the memory is large. Of at most 360 blocks.
    """
    rows = max(round(MINUTE / soak.interval), -(-len(soak.T) // 360) if fitted else 1)
    T = _means(soak.T_true, rows)
    y, z = _means(soak.bias - soak.curve, rows), _means(soak.memory, rows)
    X = np.column_stack([_splines(T, piece), np.linspace(-1, 1, len(T))])
    scale = np.abs(z).max(axis=0)
    seen = scale > 0
    if not seen.any():
        return 0.0
    y, z = y[:, seen] / soak.noise.white, z[:, seen] / scale[seen]
    white = np.eye(len(T)) / (rows * soak.interval)
    likely = np.full((2, seen.sum()), -np.inf)
    for slow in NOISES[:3] if fitted else (soak.noise.slow,):
        noise = replace(soak.noise, slow=slow)
        every = block_covariance(noise, len(T), rows * round(soak.interval / soak.base), soak.base) / noise.white**2
        if not fitted:
            without, with_it, _, _ = _contrasts(every, X, y, z)
            return float(0.5 * (without - with_it).sum())
        for share in 4.0 ** np.arange(-4, 9):
            *squares, free, spread = _contrasts(white + share * (every - white), X, y, z)
            likely = np.maximum(likely, -0.5 * (free * np.log(squares) + spread))
    return float((likely[1] - likely[0]).sum())


def _contrasts(C: np.ndarray, X: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Return squares left without and with z (d,), degrees of freedom, and log |C| + log |X' C^-1 X|."""
    L = np.linalg.cholesky(C)
    white = np.linalg.solve(L, np.column_stack([X, y, z]))
    q, s, _ = np.linalg.svd(white[:, : X.shape[1]], full_matrices=False)
    kept = s > 1e-9 * s[0]
    left = white[:, X.shape[1] :] - q[:, kept] @ (q[:, kept].T @ white[:, X.shape[1] :])
    y, z = np.hsplit(left, 2)
    power = (z**2).sum(axis=0)
    # a shape of which the free curve leaves nothing has no coefficient
    there = power > 1e-12 * (white[:, -z.shape[1] :] ** 2).sum(axis=0)
    without = (y**2).sum(axis=0)
    with_it = without - np.where(there, (y * z).sum(axis=0) ** 2 / np.where(there, power, 1.0), 0.0)
    spread = 2 * np.log(np.diag(L)).sum() + 2 * np.log(s[kept]).sum()
    return without, with_it, len(C) - int(kept.sum()), float(spread)


def _splines(T: np.ndarray, piece: float) -> np.ndarray:
    """Return the cubic B-splines (N, p) over the range of T; their sum is one, so they hold the level."""
    from scipy.interpolate import BSpline

    count = max(int(np.ceil(np.ptp(T) / piece)), 4)
    inner = np.linspace(T.min(), T.max() + 1e-9, count + 1)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    return BSpline.design_matrix(T, knots, 3).toarray()


# --- the campaign


@dataclass(frozen=True)
class Cell:
    """One cell of the design: `cell.soaks(100)` are its soaks."""

    memory: str
    profile: str
    hours: float
    noise: str
    size: float  # rad/s
    seed: int

    def soak(self, k: int, **more: float) -> Soak:
        """Return soak k; `more` goes to `draw`."""
        return draw(self.seed + k, self.profile, self.hours, self.noise, self.memory, self.size, **more)

    def soaks(self, count: int = 100, **more: float) -> Iterator[Soak]:
        """Iterate over the first soaks of the cell."""
        return (self.soak(k, **more) for k in range(count))


def cells(
    memories: tuple[str, ...] = MEMORIES,
    profiles: tuple[str, ...] = PROFILES,
    hours: tuple[float, ...] = (2.0, 4.0, 6.0, 8.0, 12.0),
    noises: tuple[str, ...] = NOISES[:3],
    sizes: tuple[float, ...] = (8 * DEG_H, 24 * DEG_H),
    seed: int = 0,
) -> Iterator[Cell]:
    """Iterate over the design; seeds of cells are 100,000 apart, and another `seed` gives fresh soaks.

    With memories=("none",) and sizes=(0.0,) these are the soaks with nothing planted.
    """
    design = [(m, p, h, n, s) for m in memories for p in profiles for h in hours for n in noises for s in sizes]
    for k, row in enumerate(design):
        yield Cell(*row, seed=(seed * 100_003 + k) * 100_000)
