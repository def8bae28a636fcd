"""Coarse alignment: the first stretch at rest gives the attitude and the velocity that are then frozen.

The mean specific force says where up is, and so which part of the Earth rate each axis sees. The unit counts as at
rest where no epoch of the stretch stands out and the scatter is not far beyond the declared noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftlab.config import Config, Filter
from driftlab.zupt.earth import earth_rate, gravity
from fusion_core.chunk import Array, Chunk
from fusion_core.errors import BadValue
from fusion_core.units import along_axes

FAR_BEYOND = 10.0  # times the declared noise: more is motion, not a wrong noise figure
FAR_FROM_GRAVITY = 0.2  # of it: more is a wrong unit, not an accelerometer's error
OUTLIER = 8.0  # times the scatter of the stretch itself
UNKNOWN = 1e-3  # of gravity: bias of an accelerometer of which nothing is said


@dataclass(frozen=True)
class Alignment:
    """The frozen reference.

    Attributes
    ----------
    t : float
        Time of the last epoch of the stretch, s.
    dt : float
        The usual duration of an epoch, s.
    omega_ie : (d,) array
        Earth rate about the gyro's axes, rad/s; zero where the latitude or the vertical is not known.
    f_ref : (3,) array or None
        Specific force of an ideal unit at rest, m/s^2; None without accelerometers.
    up : (3,) array or None
        Unit vector up in the axes of the unit.
    noise_ratio : dict of str to (3,) array
        Measured white noise over declared noise, for each triad.
    tilt : (d,) array
        Deviation of `omega_ie` because the accelerometers' biases tilt the vertical, rad/s.
    """

    t: float
    dt: float
    omega_ie: Array
    f_ref: Array | None
    up: Array | None
    noise_ratio: dict[str, Array]
    tilt: Array

    def rest_of(self, channel: str) -> Array:
        """Return what an ideal triad shows at rest (d,): Earth rate, or the specific force that holds it up."""
        if channel == "gyro":
            return self.omega_ie
        assert self.f_ref is not None, "the alignment of a filter with accelerometers has a specific force"
        return self.f_ref

    @cached_property
    def gate_scale(self) -> float:
        """How much larger the innovations may be because the declared noise is too small."""
        worst = max(float(np.mean(ratio**2)) for ratio in self.noise_ratio.values())
        return max(1.0, worst)


def noise_ratios(window: Chunk, settings: Filter) -> dict[str, Array]:
    """Return the scatter of the epochs over what the declared noise makes of it, for each triad (d,).

    The scatter is taken from differences of neighbours (a drift over the stretch does not count).
    """
    ratios = {}
    for name, section in _triads(settings).items():
        values = window[name]
        density = along_axes(section, values.shape[1])
        spread = np.diff(values, axis=0) / np.sqrt(1 / window["tau"][1:] + 1 / window["tau"][:-1])[:, None]
        ratios[name] = np.sqrt(np.mean(spread**2, axis=0)) / density
    return ratios


def at_rest(window: Chunk, settings: Filter) -> bool:
    """Return whether the unit was at rest over the epochs of `window`."""
    for name, section in _triads(settings).items():
        values = window[name]
        density = along_axes(section, values.shape[1])
        away = np.abs(values - np.median(values, axis=0)) * np.sqrt(window["tau"])[:, None] / density
        scatter = np.median(away, axis=0) / 0.6745
        if np.any(scatter > FAR_BEYOND) or np.any(away > OUTLIER * np.maximum(scatter, 1.0)):
            return False
    return True


def check_gravity(window: Chunk, config: Config) -> None:
    """Raise BadValue where what the accelerometers show at rest cannot be gravity: a unit that is not theirs."""
    expected = gravity(config.latitude)
    found = float(np.linalg.norm(np.mean(window["accel"], axis=0)))
    if not abs(found / expected - 1) < FAR_FROM_GRAVITY:
        raise BadValue(
            f"accel: shows {found:.4g} m/s^2 at rest, {expected:.4g} was expected; "
            "correct the unit and path of source.channels.accel, or write `accel: null` under filter"
        )


def align(window: Chunk, config: Config, settings: Filter) -> Alignment:
    """Freeze the reference from the epochs of a stretch at rest."""
    f_ref = up = None
    axes = settings.gyro.bias.axes
    omega_ie = tilt = np.zeros(len(axes))
    if settings.accel is not None:
        f = np.mean(window["accel"], axis=0)
        up = f / np.linalg.norm(f)
        f_ref = gravity(config.latitude) * up
    if up is not None and config.latitude is not None:
        place = ["xyz".index(axis) for axis in axes]
        omega_ie = earth_rate(up, config.latitude, config.heading)[place]
        tilt = _of_tilt(up, _accel_error(f, config, settings), config)[place]
    dt = float(np.median(window["tau"]))
    return Alignment(float(window.t[-1]), dt, omega_ie, f_ref, up, noise_ratios(window, settings), tilt)


def _accel_error(f: Array, config: Config, settings: Filter) -> float:
    """Return the deviation of an accelerometer's bias, of gravity: the config's `sigma_0`, or else as it shows.

    The length of the specific force f (3,) shows the bias along the vertical, one of three; beside it stands UNKNOWN.
    """
    expected = gravity(config.latitude)
    declared = settings.accel.bias.sigma_0 if settings.accel else None
    if declared is not None:
        return declared / expected
    return float(np.hypot(np.linalg.norm(f) / expected - 1, UNKNOWN) / np.sqrt(2))


def _of_tilt(up: Array, sigma: float, config: Config) -> Array:
    """Return the deviation (3,) of the Earth rate about the axes where the vertical is off by sigma rad either way."""
    assert config.latitude is not None
    level = np.linalg.svd(up[None])[2][1:]  # two directions across the vertical
    changes = []
    for across in level:
        moved = [up + sign * 1e-4 * across for sign in (1, -1)]
        rates = [earth_rate(u / np.linalg.norm(u), config.latitude, config.heading) for u in moved]
        changes.append((rates[0] - rates[1]) / 2e-4)
    return np.asarray(sigma * np.sqrt(np.sum(np.square(changes), axis=0)))


def _triads(settings: Filter) -> dict[str, float | tuple[float, ...]]:
    return {"gyro": settings.gyro.noise, **({"accel": settings.accel.noise} if settings.accel else {})}
