# %% [markdown]
# # First run, in Python
#
# A unit whose bias is known is simulated, a thermal map is fitted on its soak, and two filters are run on another
# recording: one that knows nothing of the temperature, and one that follows the map. Nothing but the map is written.
#
# The cells are those of a notebook: open the file in an editor that knows `# %%`, or convert it with
# `jupytext --to ipynb first_run.py`.

# %%
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

import driftlab

DEG_H = np.rad2deg(3600.0)  # deg/h in one rad/s

# %% [markdown]
# ## A unit
#
# A config is a path, YAML text or a dict. The noise is that of `mems_crs05`, a packaged product; every value has its
# unit. The unit is at rest, level, its x axis to the north.

# %%
UNIT = """
extends: mems_crs05
latitude: 40.9 deg
heading: 0 deg
source:
  kind: synthetic
  rate: 2 Hz
  latitude: 40.9 deg
  profile: {kind: table, time: [0 s, 2 h, 4 h], temperature: [15 degC, 40 degC, 15 degC]}
"""

soak = driftlab.simulate(UNIT, seed=1)
ramp = driftlab.simulate(UNIT, seed=2, duration="100 min")
soak

# %% [markdown]
# ## A map
#
# `fit_map` gives the map as arrays, and the map itself: `fitted.map.bias(T)` at any temperature.

# %%
MAP = Path(mkdtemp()) / "map.json"
BIAS = {"kind": "thermal_derivative", "walk": "2.2e-5 deg/s/sqrt(s)", "map": {"kind": "spline", "path": str(MAP)}}
PLAIN = {"extends": "mems_crs05", "latitude": "40.9 deg", "heading": "0 deg"}
TCZUPT = {**PLAIN, "filter": {"gyro": {"bias": BIAS}}}

fitted = driftlab.fit_map(TCZUPT, soak)
fitted.save(MAP)
fitted

# %% [markdown]
# ## A run
#
# The recording is a path, or arrays with units. `bias` is the estimate, `coast` what the model predicts with no
# measurement after the alignment; each has its sigma.

# %%
data = {
    "time": (ramp.time, "s"),
    "gyro": (np.rad2deg(ramp.gyro), "deg/s"),
    "accel": (ramp.accel, "m/s^2"),
    "temperature": (ramp.temperature, "degC"),
}
run = driftlab.run(TCZUPT, data)
run

# %% [markdown]
# The truth is known here, so the errors are, too.

# %%
truth = np.stack([np.interp(run.t, ramp.time, column) for column in ramp.bias_truth.T], axis=1)
coasting = np.isfinite(run.coast[:, 0])
for name in ("bias", "coast"):
    error = (run[name] - truth)[coasting] * DEG_H
    sigma = run[f"{name}_sigma"][coasting] * DEG_H
    print(f"{name}: rms {np.sqrt(np.mean(error**2, axis=0)).round(1)} deg/h, sigma {sigma.mean(axis=0).round(1)} deg/h")

# %% [markdown]
# ## With and without the map

# %%
compared = driftlab.compare({"random walk": PLAIN, "thermal derivative": TCZUPT}, data)
compared

# %%
table = compared.to_polars()
table.filter(table["row"] == "coast, to the end")

# %%
figure = compared.plot()
figure
