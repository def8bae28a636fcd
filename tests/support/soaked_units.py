"""Soaks of units in the family's basis, and what two of one unit differ by."""

from pathlib import Path

import numpy as np

from driftlab.config import load_config, understood
from driftlab.family.unit_noise import soaked_of
from driftlab.maps.fit import gather
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.faults import Faults
from fusion_core.host.config import document_of

ROOT = Path(__file__).parents[2]
UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
FAMILY = ROOT / "examples" / "06_family" / "family.yaml"
OVEN = """
source:
  kind: csv
  channels:
    time: {path: time, unit: s}
    resistance: {path: ppm, unit: ppm}
    temperature: {path: oven, unit: degC}
    ambient: {path: ambient, unit: degC}
filter:
  kind: held
  channel: resistance
  update_interval: 1 s
  align: 5 min
  noise: 0.06 ppm/sqrt(Hz)
  bias: {kind: random_walk, walk: 5e-4 ppm/sqrt(s)}
"""


def in_memory(recording):
    """A recording of `family.soak` as one in memory."""
    return InMemoryName(in_memory_name({name: (values, UNITS[name]) for name, values in recording.items()}))


def soaked(recording, config=None):
    """Return what a recording says, with the family's config or another."""
    if config is None:
        config = load_config(FAMILY)
    if isinstance(config, str):
        config = understood(document_of(config))
    name = in_memory(recording) if isinstance(recording, dict) else recording
    rows = gather(config, [name], Faults(), keep=True).rows(config.filter.tracked.channel)
    return soaked_of("unit", config.filter.tracked.axes, rows)[0]


def compared(one, other, *, level=False):
    """Chi-square a degree of freedom of the difference of two soaks, of each axis; with `level`, but for a constant."""
    knots = one.knots.joined(other.knots)
    found = []
    for (A, g), (B, h) in zip(zip(*one.on(knots), strict=True), zip(*other.on(knots), strict=True), strict=True):
        s = 1 / np.sqrt(np.maximum(np.diag(A) + np.diag(B), 1e-300))
        A, B, g, h = A * np.outer(s, s), B * np.outer(s, s), g * s, h * s
        a, b = (np.linalg.pinv(J, 1e-10, hermitian=True) @ own for J, own in ((A, g), (B, h)))
        W = A @ np.linalg.pinv(A + B, 1e-10, hermitian=True) @ B
        own, V = np.linalg.eigh((W + W.T) / 2)
        root = V[:, own > 1e-6 * own[-1]] * np.sqrt(own[own > 1e-6 * own[-1]])
        z, n = root.T @ (a - b), root.shape[1]
        if level:
            flat = root.T @ (1 / s)
            z, n = z - flat * (flat @ z) / (flat @ flat), n - 1
        found.append(float(z @ z) / n)
    return found
