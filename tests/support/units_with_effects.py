"""Units with effects that nobody declared, for the loop's tests: made sample by sample, sharing nothing with driftlab.

A level unit at rest at 40.9 deg, x to the north, in a chamber: a soak in steps up and down, a training day and a
holdout day with other profiles. Bias = curve(T) with a bend + turn-on offset + random walk + the named effects.
"""

import h5py
import numpy as np
from loop_cases.signatures import dragged, late

OMEGA_IE = np.array([5.51177e-5, 0.0, -4.77445e-5])  # level, x north, z down-looking: f_z > 0 gives + sin below
WHITE, WALK = 1.5e-5, 1.0e-7  # rad/s/sqrt(Hz), rad/s/sqrt(s)
RATE = 1.0  # Hz


def soak(hours, low=-15.0, high=50.0):
    """Steps of 5 K up and down again."""
    t = np.arange(0, hours * 3600, 1 / RATE)
    stairs = np.concatenate([np.arange(low, high, 5.0), np.arange(high, low - 1, -5.0)])
    where = np.minimum((t / t[-1] * len(stairs)).astype(int), len(stairs) - 1)
    return t, late(stairs[where], 150.0, 1 / RATE)


def day(hours, rng, low=-8.0, high=47.0):
    """Ramps and holds between random temperatures."""
    t = np.arange(0, hours * 3600, 1 / RATE)
    knots_t, knots_T = [0.0], [rng.uniform(0, 30)]
    while knots_t[-1] < t[-1]:
        target = rng.uniform(low, high)
        knots_t += [knots_t[-1] + abs(target - knots_T[-1]) / rng.uniform(0.01, 0.04), 0]
        knots_t[-1] = knots_t[-2] + rng.uniform(60, 900)
        knots_T += [target, target]
    return t, late(np.interp(t, knots_t, knots_T), 120.0, 1 / RATE)


class Unit:
    """One unit: its curve and the sizes of its effects are drawn from the seed."""

    def __init__(self, seed, effects=(), channels=(), walk=WALK):
        self.rng = np.random.default_rng(seed)
        r = self.rng
        self.effects, self.channels, self.walk = effects, channels, walk
        self.linear, self.square = r.normal(0, 5e-6, 3), r.normal(0, 1e-7, 3)
        self.bend, self.at, self.over = r.normal(0, 8e-5, 3), r.uniform(5, 35, 3), r.uniform(1.5, 4, 3)
        self.size = r.choice([-1, 1], 3) * r.uniform(0.7, 1.4, 3)

    def curve(self, T):
        T = T[:, None]
        return self.linear * T + self.square * T**2 + self.bend * np.tanh((T - self.at) / self.over)

    def auxiliary(self, t, T):
        r = self.rng
        n = len(t)

        def wander(level, spread, tau):
            noise = r.normal(size=n)
            noise[0] = 0.0  # else it begins tens of deviations away
            # bounded, as a regulator keeps it: beyond what was fitted on, an effect holds
            return level + spread * 1.5 * np.tanh(late(noise, tau, 1 / RATE) / np.sqrt(1 / (2 * tau)) / 1.5)

        made = {
            "voltage": (
                5
                + 0.4 * np.sign(np.sin(2 * np.pi * t / r.uniform(2000, 5000) + r.uniform(0, 6)))
                + wander(0, 0.1, 600),
                "V",
            ),
            "pressure": (wander(1013, 15, 2000), "hPa"),
            "flow": (wander(2, 0.5, 400), "1"),
            "temperature_case": (T + 3 * np.gradient(T, t) * 60 + wander(0, 0.2, 300), "degC"),
        }
        if "twin" in self.channels:
            made["twin"] = (2.5 * (made["voltage"][0] - 5), "V")
        return {name: made[name] for name in self.channels}

    def record(self, path, t, T):
        """Write one recording; return its true gyro bias (N, 3)."""
        r, n = self.rng, len(t)
        extra = self.auxiliary(t, T)
        seen = late(T, 150.0, 1 / RATE) if "thermal_lag" in self.effects else T
        bias = (
            self.curve(seen)
            + r.normal(0, 2e-4, 3)
            + np.cumsum(r.normal(size=(n, 3)), axis=0) * self.walk / np.sqrt(RATE)
        )
        for effect in self.effects:
            bias = bias + self.size * self.part(effect, t, T, extra)[:, None]
        gyro = bias + OMEGA_IE + r.normal(size=(n, 3)) * WHITE * np.sqrt(RATE)
        accel = np.array([0, 0, 9.80206]) + r.normal(size=(n, 3)) * 0.004
        with h5py.File(path, "w") as file:
            for name, values, unit in (
                ("time", t, "s"), ("gyro", np.rad2deg(gyro), "deg/s"), ("accel", accel, "m/s^2"),
                ("temperature", np.round(T * 16) / 16, "degC"), *((k, v, u) for k, (v, u) in extra.items()),
            ):  # fmt: skip
                file.create_dataset(name, data=values).attrs["unit"] = unit
        return bias

    def part(self, effect, t, T, extra):
        x = {name: values for name, (values, _) in extra.items()}
        return {
            "thermal_lag": lambda: 0 * t,
            "hysteresis": lambda: 2.5e-5 * dragged(T, 9.0),
            "turn_on": lambda: 2.5e-4 * np.exp(-t / 700.0),
            "drift": lambda: 2.0e-8 * t,
            "thermal_rate": lambda: 5e-3 * np.gradient(T, t),
            "channel": lambda: 2e-4 * (x["voltage"] - 5),
            "interaction": lambda: 1.2e-5 * (x["voltage"] - 5) * (T - 20),
            "square": lambda: 1.5e-4 * (x["flow"] - 2) ** 2 / 0.25,
            "periodic": lambda: 8e-5 * np.sin(2 * np.pi * t / 97.0),
            "bands": lambda: 2e-4 * (x["voltage"] - 5) * np.cos(2 * np.pi * (T - 20) / 30),
            "late": lambda: 6e-5 * late(x["flow"] - 2, 900.0, 1 / RATE) / 0.3,
            "gradient": lambda: 4e-5 * (x["temperature_case"] - T),
            "telegraph": lambda: 8e-5 * np.sign(np.sin(2 * np.pi * (t / 3300.0) ** 1.3)),
        }[effect]()


def make_unit(folder, seed, effects=(), channels=(), hours=(2.4, 1.8, 1.6), walk=WALK, once=False):
    """Write soak.h5, train.h5, holdout.h5 and declared.yaml; return the holdout's true bias."""
    unit = Unit(seed, effects, channels, walk)
    profiles = {"soak": soak(hours[0]), "train": day(hours[1], unit.rng), "holdout": day(hours[2], unit.rng)}
    if once:  # only ever warmed up, always alike
        t = np.arange(0, hours[0] * 3600, 1 / RATE)
        warm = lambda low, tau: low + (45 - low) * (1 - np.exp(-t / tau))  # noqa: E731
        profiles |= {"soak": (t, warm(-10.0, 3000.0)), "train": (t, warm(-9.0, 3000.0))}
    truth = {name: unit.record(folder / f"{name}.h5", *profile) for name, profile in profiles.items()}
    units = {"voltage": "V", "pressure": "hPa", "flow": '"1"', "temperature_case": "degC", "twin": "V"}
    named = "\n".join(f"    {name}: {{path: {name}, unit: {units[name]}}}" for name in channels)
    (folder / "declared.yaml").write_text(CONFIG.format(channels=named))
    return truth["holdout"]


CONFIG = """
latitude: 40.9 deg
heading: 0 deg
source:
  kind: hdf5
  channels:
    time: {{path: time, unit: s}}
    gyro: {{path: gyro, unit: deg/s}}
    accel: {{path: accel, unit: m/s^2}}
    temperature: {{path: temperature, unit: degC}}
{channels}
filter:
  update_interval: 1 s
  align: 60 s
  gyro:
    noise: 3.1 deg/h/sqrt(Hz)
    bias: {{kind: thermal_derivative, walk: 0.02 deg/h/sqrt(s), map: {{kind: spline}}}}
  accel:
    noise: 0.004 m/s^2/sqrt(Hz)
    bias: {{kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}}
"""
