"""Made-up soaks, and the maps of each kind that are fitted to one."""

import numpy as np
import pytest

from fusion_plugins.thermal_maps.onnx_network import OnnxNetwork
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

NOISE = 1e-4  # rad/s, of a sample


DEG_H = np.degrees(1) * 3600


ALL = [Polynomial(), Spline(), OnnxNetwork(starts=3)]


kinds = pytest.mark.parametrize("maps", ALL, ids=lambda maps: maps.kind)


def smooth(T):
    """A curve of 3 axes that all kinds can follow, about 1e-3 rad/s over -20 to 50 degC."""
    x = (T - 15) / 35
    return 1e-3 * np.stack([0.3 + x - 0.5 * x**2, 0.8 * x**3 - x, 0.2 * x + 0.4 * x**2], axis=1)


def abrupt(T):
    """A smooth curve with a change by 6e-4 rad/s within about 2 K at 22 degC."""
    return (1e-5 * T + 3e-4 * np.tanh((T - 22) / 1.0))[:, None]


def soak(curve, N=20_000, seed=0, noise=NOISE, low=-20.0, high=50.0):
    rng = np.random.default_rng(seed)
    T = rng.uniform(low, high, N)
    bias = curve(T)
    return T, bias + noise * rng.normal(size=bias.shape)


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


T_ok = np.linspace(0, 40, 400)
b_ok = np.stack([1e-4 * np.sin(T_ok / 9), 1e-6 * T_ok], axis=1)
