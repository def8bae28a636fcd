"""In which units an Allan analysis is shown, and what its terms are called."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from driftlab.noise.model import KEYS

if TYPE_CHECKING:
    from driftlab.noise.deviation import Analysis

NAMES = dict(zip(KEYS, ("quantisation", "white noise", "bias instability", "random walk", "ramp"), strict=True))


@dataclass(frozen=True)
class Units:
    """The units of a sensor: of its deviation, and of each coefficient in SI and for people (by key)."""

    deviation: str
    deviation_si: str
    si: dict[str, str]
    human: list[tuple[str, str]]

    def config(self, key: str) -> str:
        """Return the unit in which a coefficient is written in a config."""
        return dict(reversed(self.human))[key]


UNITS = {
    "gyro": Units(
        "deg/h",
        "rad/s",
        dict(zip(KEYS, ("rad", "rad/s/sqrt(Hz)", "rad/s", "rad/s/sqrt(s)", "rad/s/s"), strict=True)),
        [
            ("quantization", "arcsec"), ("white", "deg/h/sqrt(Hz)"), ("white", "deg/sqrt(h)"),
            ("bias_instability", "deg/h"), ("rate_random_walk", "deg/h/sqrt(s)"), ("rate_ramp", "deg/h/s"),
        ],
    ),
    "accel": Units(
        "ug",
        "m/s^2",
        dict(zip(KEYS, ("m/s", "m/s^2/sqrt(Hz)", "m/s^2", "m/s^2/sqrt(s)", "m/s^2/s"), strict=True)),
        [
            ("quantization", "mm/s"), ("white", "ug/sqrt(Hz)"), ("white", "m/s/sqrt(h)"),
            ("bias_instability", "ug"), ("rate_random_walk", "ug/sqrt(s)"), ("rate_ramp", "ug/s"),
        ],
    ),
}  # fmt: skip
PER = ("*s", "/sqrt(Hz)", "", "/sqrt(s)", "/s")  # of a coefficient, after the unit of the sensor


def units_of(found: Analysis, channel: str) -> Units:
    """Return the units of a channel: those of data sheets for gyros and accelerometers, else its own."""
    sensor, known = found.sensors.get(channel), UNITS.get(channel)
    if known is not None and (sensor is None or sensor.unit == known.deviation_si):
        return known
    assert sensor is not None, "what is no triad is a sensor of the config"
    si = {
        key: "s" if sensor.unit == "1" and per == "*s" else sensor.unit + per
        for key, per in zip(KEYS, PER, strict=True)
    }
    return Units(sensor.shown, sensor.unit, si, [(key, sensor.shown + per) for key, per in zip(KEYS, PER, strict=True)])
