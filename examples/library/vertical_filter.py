# %% [markdown]
# # A vertical filter with the bias of its accelerometer
#
# An accelerometer at 100 Hz drives the model, a barometer at 10 Hz corrects it, and height, climb and the
# accelerometer's bias come out. What follows the line `# the filter` is all that one writes.

# %%
import numpy as np

from fusion_core import Block, Measurement, State, StateSpace, Transition, estimate, van_loan

rng = np.random.default_rng(0)
dt, N = 0.01, 12_000
t = np.arange(1, N + 1) * dt
a = 1.5 * np.sin(2 * np.pi * t / 13.0) * np.cos(2 * np.pi * t / 50.0)
climb = np.cumsum(a) * dt
height = np.cumsum(climb - a * dt / 2) * dt  # a is constant over a step
bias = 0.08 + np.cumsum(rng.normal(size=N)) * 5e-4 * np.sqrt(dt)
accel = a + bias + rng.normal(size=N) * 2e-3 / np.sqrt(dt)
baro = height + rng.normal(size=N) * 0.4
heard = np.arange(N) % 10 == 0

# %%
# the filter
prior = State(np.zeros(3), np.diag([10.0, 1.0, 0.2]) ** 2)
space = StateSpace([Block("vertical", ("height", "climb", "bias"), ("m", "m/s", "m/s^2"), prior)])
A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
F, Q = van_loan(A, np.diag([0.0, 2e-3, 5e-4]) ** 2, dt)
u = accel[:, None] * [dt**2 / 2, dt, 0.0]
measurement = Measurement(baro[:, None], np.array([[1.0, 0.0, 0.0]]), np.array([[0.4**2]]), heard)
found = estimate(space.prior(), Transition(F, Q, u), measurement)

# %% [markdown]
# After 20 s the bias is known, and the height is known better than the barometer has it.

# %%
late = t > 20
for place, true in enumerate((height, climb, bias)):
    error = (found.x[:, place] - true)[late]
    print(
        f"{space.labels[place]}: rms error {np.sqrt(np.mean(error**2)):.4f} {space.units[place]}, "
        f"{np.mean(found.sigma[late, place]):.4f} by the filter's own word"
    )
