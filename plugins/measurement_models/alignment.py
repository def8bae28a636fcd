"""Coarse alignment: the first stretch at rest gives the attitude and the velocity that are then frozen.

The mean specific force says where up is, and so which part of the Earth rate each axis sees. The unit counts as at
rest where no epoch of the stretch stands out and the scatter is not far beyond the declared noise: of the readings
themselves, or of what a smooth curve leaves of them, as steep as a bias may be over the temperature of the stretch.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin, sqrt

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, Sensor, Site
from fusion_core.errors import BadValue
from fusion_plugins.earth import RATE, earth_rate, gravity

FAR_BEYOND = 10.0  # times the declared noise: more is motion, not a wrong noise figure
FAR_FROM_GRAVITY = 0.2  # of it: more is a wrong unit, not an accelerometer's error
OFF, SURE = 0.03, 3.0  # of gravity, and deviations of the declared bias: more is an error of scale
OUTLIER = 8.0  # times the scatter of the stretch itself
STEEPEST = {"rad/s": np.deg2rad(150 / 3600), "m/s^2": 1e-2}  # a K: 150 deg/h, 1 mg
STEEP = 5.0  # times the density of the white noise, a K: what is in a unit of its own
CUBIC, BEND = 3, 2.0  # degree of a curve over the time, and K of each degree more
SLOW = 10.0  # s of each degree at least: what is faster is motion
MIN_EPOCHS = 8  # epochs of each degree at least
UNKNOWN = 1e-3  # of gravity: bias of an accelerometer that is not declared
LARGE = 2e-2  # of gravity: the bias that one may have all the same


def at_rest(window: Chunk, sensors: Sequence[Sensor]) -> bool:
    """Return True if the unit was at rest over the epochs of `window`."""
    root = np.sqrt(window["tau"])[:, None]
    for sensor in sensors:
        values = window[sensor.channel]
        away = np.abs(values - _median(values)) * root / sensor.noise
        scatter = _median(away) / 0.6745
        level = (scatter <= FAR_BEYOND).all() and (away <= OUTLIER * np.maximum(scatter, 1.0)).all()
        if not (level or _follows_temperature(window, sensor)):
            return False
    return True


def steepest(sensor: Sensor) -> Array:
    """Return the largest change of the bias (d,) with temperature, in the sensor's unit per K: more is motion."""
    return np.asarray(np.maximum(STEEPEST[sensor.unit], STEEP * sensor.noise))


def _follows_temperature(window: Chunk, sensor: Sensor) -> bool:
    """Return True if a sensor shows a curve over temperature and time, and white noise.

    The curve is a polynomial of the time and the temperature itself; it may go as far as the steepest bias does over
    what the temperature moves, and no farther. What it leaves stands beside its own differences: a step of which the
    curve has taken a part does not pass for noise.
    """
    if "temperature" not in window.channels or len(window) < MIN_EPOCHS:
        return False
    T, values, length = window["temperature"], window[sensor.channel], float(window.t[-1] - window.t[0])
    u = 2 * (window.t - window.t[0]) / length - 1
    degree = int(min(CUBIC + np.ptp(T) / BEND, length / SLOW, len(u) / MIN_EPOCHS))
    if degree < 1:
        return False
    time = np.polynomial.chebyshev.chebvander(u, degree)
    both = np.column_stack([T, values])
    smooth = time @ np.linalg.lstsq(time, both, rcond=None)[0]
    scale = np.sqrt(window["tau"])[:, None] / sensor.noise
    moved = np.ptp(smooth, axis=0)
    if "temperature_rate" in window.channels:  # a thermometer of coarse steps shows it over longer
        moved[0] = max(moved[0], float(np.mean(np.abs(window["temperature_rate"]))) * length)
    if np.any(moved[1:] > steepest(sensor) * moved[0] + OUTLIER / _median(scale)):
        return False
    left = (both - smooth) * np.hstack([np.ones_like(scale[:, :1]), scale])
    white = np.maximum(_median(np.abs(np.diff(left[:, 1:], axis=0))) / 0.6745 / np.sqrt(2), 1.0)
    width = max(1, round(SLOW / 2 / length * len(u)))  # of a mean in which the thermometer's own noise is small
    off = np.convolve(left[:, 0], np.full(width, 1 / width), "same")[:, None]
    shape = np.sum(off * left[:, 1:], axis=0) / max(float(np.sum(off**2)), 1e-30)
    return bool(np.all(white <= FAR_BEYOND) and np.all(np.abs(left[:, 1:] - off * shape) <= OUTLIER * white))


def _median(values: Array) -> Array:
    """Return the median (d,) of values (N, d): NumPy's own takes five times as long over so few."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(np.ascontiguousarray(values.T), (low, high))
    return np.asarray((ordered[:, low] + ordered[:, high]) / 2)


def align(window: Chunk, site: Site, gyro: Sensor, accel: Sensor | None, tracked: str = "gyro") -> Alignment:
    """Freeze the reference from the epochs of a stretch at rest.

    The gyro's input is the Earth rate, zero where the latitude or the vertical is not known; the accelerometers' is
    the specific force that holds an ideal unit up. Across the vertical their bias is counted from there on: what it
    was in the stretch is one with the tilt. So nothing of their input is unsure where they are tracked.
    """
    up = None
    omega_ie = unsure = np.zeros(len(gyro.axes))
    inputs: dict[str, Array] = {}
    notes, off = tuple[str, ...](), tuple[str, ...]()
    if accel is not None:
        f = np.add.reduce(window[accel.channel]) / len(window)
        up = f / sqrt(f @ f)
        inputs[accel.channel] = gravity(site.latitude) * up
        off = _of_scale(f, site, accel)
    if accel is not None and up is not None and site.latitude is not None:
        place = ["xyz".index(axis) for axis in gyro.axes]
        omega_ie, a_radian = (rate[place] for rate in _rate_and_tilt(up, site))
        unsure = _accel_error(f, site, accel) * a_radian
        if tracked == gyro.channel:
            notes = _of_bias(LARGE * a_radian, gyro, accel, float(np.sum(window["tau"])))
    inputs[gyro.channel] = omega_ie
    dt = float(_median(window["tau"][:, None])[0])
    sensors = (gyro,) if accel is None else (gyro, accel)
    if accel is not None and tracked == accel.channel:
        unsure = np.zeros(len(accel.axes))
    return Alignment(float(window.t[-1]), dt, inputs, noise_ratios(window, sensors), unsure, up, notes=notes, off=off)


def check_gravity(window: Chunk, site: Site) -> None:
    """Raise BadValue where what the accelerometers show at rest cannot be gravity: a unit that is not theirs."""
    expected = gravity(site.latitude)
    measured = hypot(*(np.add.reduce(window["accel"]) / len(window)).tolist())
    if not abs(measured / expected - 1) < FAR_FROM_GRAVITY:
        raise BadValue(
            f"accel: shows {measured:.4g} m/s^2 at rest, {expected:.4g} was expected; "
            "correct the unit and path of source.channels.accel, or write `accel: null` under filter"
        )


def _accel_error(f: Array, site: Site, accel: Sensor) -> float:
    """Return the deviation of an accelerometer's bias, of gravity: the config's `sigma_0`, or else as it shows.

    The length of the specific force f (3,) shows the bias along the vertical, one of three; beside it stands UNKNOWN.
    """
    expected = gravity(site.latitude)
    if accel.bias.sigma_0 is not None:
        return accel.bias.sigma_0 / expected
    return hypot(sqrt(f @ f) / expected - 1, UNKNOWN) / sqrt(2)


def _of_scale(f: Array, site: Site, accel: Sensor) -> tuple[str, ...]:
    """Return a note on a specific force f (3,) whose length no declared bias makes that of gravity."""
    expected, measured = gravity(site.latitude), float(np.linalg.norm(f))
    if abs(measured / expected - 1) <= max(OFF, SURE * (accel.bias.sigma_0 or 0.0) / expected):
        return ()
    return (
        f"{accel.channel}: shows {measured:.4g} m/s^2 at rest, gravity there is {expected:.4g}: its scale, or its bias "
        f"along the vertical, is off by {measured / expected - 1:+.1%}; correct the unit of source.channels."
        f"{accel.channel}, calibrate it, or declare {accel.section}.bias.sigma_0",
    )


def _of_bias(leak: Array, gyro: Sensor, accel: Sensor, length: float) -> tuple[str, ...]:
    """Return a note on the effect of an accelerometer bias of LARGE, where none is declared and a gyro could see it.

    Across the vertical it is one with a tilt: `leak` (d,) is the Earth rate that goes to the gyro's bias for it.
    """
    declared = accel.bias.sigma_0 is not None or accel.calibration is not None
    if declared or (leak <= gyro.noise / sqrt(length)).all():
        return ()
    each = ", ".join(f"{axis} {np.rad2deg(v) * 3600:.2g}" for axis, v in zip(gyro.axes, leak, strict=True))
    return (
        f"{accel.section}.bias.sigma_0: is missing, and an accelerometer's bias across the vertical is one with "
        f"a tilt; one of {1e3 * LARGE:.0f} mg puts the gyro's bias off by {each} deg/h through the Earth rate, and its "
        f"sigma reckons with {1e3 * UNKNOWN:.0f} mg or what the length of gravity shows; write the "
        f"offset that its data sheet allows, as in {accel.section}.bias.sigma_0: {1e3 * LARGE:.0f} mg",
    )


def _rate_and_tilt(up: Array, site: Site) -> tuple[Array, Array]:
    """Return the Earth rate (3,) about the axes, and its deviation a radian that the vertical is off either way.

    Off by a radian along the level part X of the x axis, which has the heading h, or along Y across it::

        s X - c cos h up,    s Y + c (k (sin h X - cos h Y) - sin h up),    k = up_x / |level part of x|

    s and c the vertical and the level part of the Earth's rate.
    """
    assert site.latitude is not None
    rate, s, c = earth_rate(up, site.latitude, site.heading), RATE * sin(site.latitude), RATE * cos(site.latitude)
    if site.heading is None:
        return rate, np.asarray(abs(s) * np.sqrt(np.maximum(1 - up**2, 0.0)))
    east, north, (x, y, z), level = sin(site.heading), cos(site.heading), up.tolist(), sqrt(1 - up[0] ** 2)
    X, Y = np.array([level, -x * y / level, -x * z / level]), np.array([0.0, z / level, -y / level])
    along = s * X - c * north * up
    across = s * Y + c * (x / level * (east * X - north * Y) - east * up)
    return rate, np.asarray(np.sqrt(along**2 + across**2))


def noise_ratios(window: Chunk, sensors: Sequence[Sensor]) -> dict[str, Array]:
    """Return the scatter of the epochs over what the declared noise makes of it, for each sensor (d,).

    The scatter is that of differences of neighbours about their mean, since a temperature that goes on moves the
    bias; 1 where there are none. The mean of n is of the two ends: it takes 1 / n^2 of their squares.
    """
    ratios, tau = {}, window["tau"]
    root = np.sqrt(1 / tau[1:] + 1 / tau[:-1])[:, None]
    for sensor in sensors:
        values = window[sensor.channel]
        if len(values) < 2:
            ratios[sensor.channel] = np.ones(values.shape[1])
            continue
        steps, n = (values[1:] - values[:-1]) / root, len(root)
        squares = np.add.reduce(np.square(steps)) / n
        if n > 1:
            squares = (squares - np.square(np.add.reduce(steps) / n)) / (1 - 1 / n**2)
        ratios[sensor.channel] = np.sqrt(np.maximum(squares, 0.0)) / sensor.noise
    return ratios
