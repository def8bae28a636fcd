# %% [markdown]
# # A constant-velocity tracker
#
# A target moves in a plane and turns now and then. A position fix comes once a second, some are missing, some are
# wrong. What follows the line `# the tracker` is all that one writes.

# %%
import numpy as np

from fusion_core import Block, Measurement, State, StateSpace, Transition, estimate, gate_of, van_loan

rng = np.random.default_rng(0)
t = np.arange(0.0, 120.0, 0.1)
course = np.cumsum(rng.normal(size=len(t)) * 0.02)
truth = np.cumsum(4.0 * 0.1 * np.column_stack([np.cos(course), np.sin(course)]), axis=0)
fixes = truth + rng.normal(size=truth.shape) * 2.0
fixed = (np.arange(len(t)) % 10 == 0) & (rng.random(len(t)) > 0.2)
fixes[150::150] += 80.0  # wrong ones

# %%
# the tracker
eye = np.eye(2)
space = StateSpace([
    Block("position", ("x", "y"), "m", State(np.zeros(2), 100.0**2 * eye)),
    Block("velocity", ("x", "y"), "m/s", State(np.zeros(2), 10.0**2 * eye)),
])  # fmt: skip
A = space.matrix({("position", "velocity"): eye})
Q_c = space.matrix({("velocity", "velocity"): 0.6**2 * eye})
F, Q = van_loan(A, Q_c, 0.1)
measurement = Measurement(fixes, space.output({"position": eye}), 2.0**2 * eye, fixed)
track = estimate(space.prior(), Transition(F, Q, np.zeros(4)), measurement, gate=gate_of(2, 1e-6))
position = track.x[:, space.places["position"]]

# %% [markdown]
# The fixes have 2 m an axis; the track is better, and it says how good it is.

# %%
late = t > 10
error = (position - truth)[late]
own = np.mean(track.sigma[late, :2])
print(f"rms error {np.sqrt(np.mean(error**2)):.2f} m an axis, {own:.2f} m by the filter's own word")
print(f"{fixed.sum()} fixes, {fixed.sum() - track.used.sum()} refused")
