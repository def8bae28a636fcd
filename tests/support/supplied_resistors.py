"""A resistor at a constant input whose reading follows its supply, in CSV; beyond what was seen, a test draws it."""

import numpy as np

PPM = 1e-6
STEP = 10.0  # s
DECLARED = """
source:
  kind: csv
  channels:
    time:        {path: time, unit: s}
    resistance:  {path: ppm, unit: ppm}
    temperature: {path: oven, unit: degC}
    supply:      {path: supply, unit: V}
filter:
  kind: held
  channel: resistance
  update_interval: 10 s
  align: 300 s
  noise: 0.16 ppm/sqrt(Hz)
  bias:
    kind: thermal_derivative
    walk: 2e-3 ppm/sqrt(s)
    map: {kind: polynomial, order: 1, outside: clamp}
"""


def table(seed, answer, low=4.8, high=5.2, hours=2.5, supply=None):
    """Return time, reading, temperature and supply (N, 4); `answer` (N,) of the supply is in ppm."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, hours * 3600, STEP)
    T = 30 + 5 * np.sin(t / rng.uniform(900, 1300) + rng.uniform(0, 6))
    if supply is None:
        supply = np.interp(t, np.arange(0, t[-1] + 900, 900), rng.uniform(low, high, int(t[-1] // 900) + 2))
    ppm = 0.3 * (T - 30) + answer(supply) + 0.05 * rng.normal(size=len(t)) + rng.normal()
    return np.stack([t, ppm, T, supply], axis=1)


def write(path, rows, digits=9):
    """Write a recording as CSV."""
    np.savetxt(path, rows, delimiter=",", header="time,ppm,oven,supply", comments="", fmt=f"%.{digits}g")
    return str(path)


def unit(folder, answer, beyond=None, supply=None, **holdout):
    """Write the config, a soak, a day of training and one to judge by; return the arguments of `explain`."""
    (folder / "declared.yaml").write_text(DECLARED)
    names = [[write(folder / f"{name}.csv", table(k, answer))] for k, name in enumerate(("soak", "train"))]
    rows = table(7, beyond or answer, supply=supply, **holdout)
    return folder / "declared.yaml", *names, [write(folder / "holdout.csv", rows)]
