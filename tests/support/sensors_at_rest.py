"""One axis of a sensor at rest, whose noise is known term by term, for Allan deviations."""

import numpy as np

DT = 0.1


def simulated(samples, seed, *, quantization=0.0, white=0.0, walk=0.0, ramp=0.0):
    """Samples as an integrating sensor gives them: means over DT of what goes on inside."""
    rng = np.random.default_rng(seed)
    inside = np.cumsum(rng.normal(size=samples * 8)) * walk * np.sqrt(DT / 8)
    rate = inside.reshape(samples, 8).mean(axis=1) + rng.normal(size=samples) * white / np.sqrt(DT)
    return rate + np.diff(rng.normal(size=samples + 1) * quantization) / DT + ramp * np.arange(samples) * DT
