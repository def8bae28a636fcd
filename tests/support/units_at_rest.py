"""A unit at rest, made sample by sample for the tests; shares nothing with the filter."""

from dataclasses import dataclass

import h5py
import numpy as np

UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
OMEGA_IE = np.array([5.51177e-5, 0.0, 4.77445e-5])  # level, x north, 40.9 deg: rate (cos, 0, sin)
G = 9.80206  # m/s^2 at 40.9 deg by the tables of WGS 84


@dataclass
class Unit:
    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    temperature: np.ndarray
    bias: np.ndarray

    def channels(self):
        return {"gyro": self.gyro, "accel": self.accel, "temperature": self.temperature}

    def write(self, path):
        """Write it as an HDF5 file, each channel with its unit."""
        with h5py.File(path, "w") as file:
            for name, values in {"time": self.t, **self.channels()}.items():
                file.create_dataset(name, data=values).attrs["unit"] = UNITS[name]


def thermal_bias(T):
    """A curve with a bend, rad/s."""
    return np.stack([1e-3 + 2e-5 * T + 1e-6 * T**2, -2e-3 - 3e-5 * T, 5e-4 * np.tanh((T - 25) / 8)], axis=1)


def unit_at_rest(
    *, seconds=600.0, rate=20.0, noise=1.54e-5, walk=2.6e-6, vrw=8.333e-4, temperature=None, seed=0, offset=(0, 0, 0)
):
    """White noise, rate random walk and a thermal bias, level with x to the north at 40.9 deg latitude."""
    rng = np.random.default_rng(seed)
    N = int(seconds * rate)
    t = np.arange(N) / rate
    T = np.full(N, 25.0) if temperature is None else temperature(t)
    bias = np.cumsum(rng.normal(size=(N, 3)) * walk / np.sqrt(rate), axis=0) + thermal_bias(T) + offset
    gyro = OMEGA_IE + bias + rng.normal(size=(N, 3)) * noise * np.sqrt(rate)
    accel = np.array([0, 0, G]) + [0.01, -0.02, 0.03] + rng.normal(size=(N, 3)) * vrw * np.sqrt(rate)
    return Unit(t, gyro, accel, T, bias)
