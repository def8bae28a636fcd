"""Units on a turntable and in a tumble over temperature, simulated sample by sample; nothing is shared with a fit.

The readings are y = u + M(T) u + b(T) + G(T) f + white noise + a walk of the bias. N samples.
"""

from __future__ import annotations

import numpy as np

AXES = np.eye(3)


def matrix_of(T):
    """M (3, 3) at T: scale factors of 1 % that move by as much over 60 K, misalignments of mrad, one of them moving."""
    x = (T - 20.0) / 40.0
    M = np.array([[0.004, 0.003, -0.005], [0.002, -0.008, 0.006], [-0.001, 0.004, 0.01]])
    M[0, 0] += 0.006 * x
    M[2, 2] += -0.004 * x + 0.002 * x**2
    M[1, 2] += 0.0015 * x
    return M


def bias_of(T, size):
    """Return b (3,) at T, in the unit of `size`."""
    x = (T - 20.0) / 40.0
    return size * np.array([0.5 + 0.6 * x - 0.3 * x**2, -0.3 + 0.2 * x**3, 0.1 * x])


def sensitivity_of(T):
    """Return G (3, 3) at T, rad/s a m/s^2: up to 0.15 deg/s/g, one term moving by a third of that."""
    G = np.array([[1.2, -0.4, 0.3], [0.5, -2.6, 0.8], [-0.2, 0.6, 1.8]]) * 1e-4
    G[2, 2] += 0.3e-4 * (T - 20.0) / 40.0
    return G


def sensor_frame(M):
    """Return M in the frame that the sensor itself defines: (I + M) R is upper triangular, R a rotation."""
    A = np.eye(3) + M
    rotated, _ = np.linalg.qr(A[::-1].T)  # rows from the last on: z first, then y
    A = A @ rotated[:, ::-1]
    return A * np.sign(np.diag(A)) - np.eye(3)


class Readings:
    """Samples of a triad that are put together stretch by stretch."""

    def __init__(self, seed, rate, white, walk, bias):
        self.rng, self.dt = np.random.default_rng(seed), 1.0 / rate
        self.white, self.walk, self.bias = white, walk, bias
        self.y, self.T, self.f, self.drift = [], [], [], np.zeros(3)

    @property
    def now(self):
        return sum(map(len, self.y)) * self.dt

    def stretch(self, seconds, u, T, M=None, G=None, f=None):
        """Take readings under an input u (3,) or (N, 3), and a force f alike."""
        N = round(seconds / self.dt)
        u = np.broadcast_to(np.asarray(u, float), (N, 3))
        drift = self.drift + np.cumsum(self.rng.normal(0, self.walk * np.sqrt(self.dt), (N, 3)), axis=0)
        self.drift = drift[-1]
        noise = self.rng.normal(0, self.white / np.sqrt(self.dt), (N, 3))
        M = matrix_of(T) if M is None else M
        self.f.append(np.broadcast_to(np.zeros(3) if f is None else f, (N, 3)))
        strain = 0.0 if G is None else self.f[-1] @ G.T
        self.y.append(u + u @ M.T + bias_of(T, self.bias) + strain + drift + noise)
        self.T.append(np.full(N, float(T)))

    def arrays(self):
        y = np.concatenate(self.y)
        return np.arange(len(y)) * self.dt, y, np.concatenate(self.T)


def turntable(seed, temperatures, rate=1.7453292519943295, hold=16.0, hz=10.0, axes=range(3), matrix=matrix_of):
    """Return t, gyro, T and the table of segments: each axis both ways at each temperature, with ramps between."""
    return _turned(seed, temperatures, rate, hold, hz, [AXES[k] for k in axes], matrix, lambda T: None)[:4]


def strained(seed, temperatures, rate=1.7453292519943295, hold=16.0, hz=10.0, ways=(1, -1), g=9.80665):
    """Return t, gyro, T, table and accel of a vertical table, each axis up and down, with g-sensitivity."""
    up = [way * axis for axis in AXES for way in ways]
    *found, f = _turned(seed, temperatures, rate, hold, hz, up, matrix_of, sensitivity_of, g)
    return *found, f + np.random.default_rng(seed + 1).normal(0, 0.01, f.shape)


def _turned(seed, temperatures, rate, hold, hz, up, matrix, sensitivity, g=0.0):
    made = Readings(seed, hz, white=8e-5, walk=1e-6, bias=np.deg2rad(1.0))
    lines = ["start [s],stop [s],axis,rate [deg/s]"]
    for T in temperatures:
        for axis in up:
            own = matrix(T), sensitivity(T), g * axis
            name = "-" * bool(axis.sum() < 0) + "xyz"[int(np.argmax(np.abs(axis)))]
            for sign in (1, -1):
                made.stretch(1.0, np.linspace(0, 1, 10)[:, None] * sign * rate * axis, T, *own)
                lines.append(f"{made.now:.3f},{made.now + hold:.3f},{name},{sign * np.rad2deg(rate):.9f}")
                made.stretch(hold, sign * rate * axis, T, *own)
                made.stretch(1.0, np.linspace(1, 0, 10)[:, None] * sign * rate * axis, T, *own)
    return *made.arrays(), "\n".join(lines) + "\n", np.concatenate(made.f)


def tumble(seed, temperatures, placements=18, hold=5.0, hz=10.0, g=9.80665, up=None):
    """Return t, accel, T: a unit laid in random directions, faces among them, with handling between."""
    made = Readings(seed, hz, white=5e-4, walk=1e-6, bias=0.3)
    others = np.random.default_rng(7).normal(size=(max(placements - 6, 0), 3))
    faces = np.vstack([AXES, -AXES, others])[:placements]
    for T in temperatures:
        for direction in faces if up is None else up:
            made.stretch(1.0, 9 + 3 * made.rng.normal(size=(round(hz), 3)), T)
            made.stretch(hold, g * direction / np.linalg.norm(direction), T)
    made.stretch(1.0, 9 + 3 * made.rng.normal(size=(round(hz), 3)), T)
    return made.arrays()


def ferraris_session(seed, hold=5.0, hz=50.0, g=9.80665, T=20.0):
    """Return accel and gyro (N, 3) of each section of a session by Ferraris, Grimaldi and Parvis: faces and full turns.

    Sections are named as imucal does: x_p has x up, x_a down, x_rot turns by -360 deg about x, which is up.
    """
    rng, sections = np.random.default_rng(seed), {}
    for k, axis in enumerate(AXES):
        for name, way, rate in (("p", 1, 0.0), ("a", -1, 0.0), ("rot", 1, -2 * np.pi / hold)):
            f, u = np.tile(way * g * axis, (round(hold * hz), 1)), np.tile(rate * axis, (round(hold * hz), 1))
            accel = f + f @ matrix_of(T).T + bias_of(T, 0.3) + rng.normal(0, 5e-4 * np.sqrt(hz), f.shape)
            gyro = u + u @ matrix_of(T).T + bias_of(T, np.deg2rad(1.0)) + f @ sensitivity_of(T).T
            sections[f"{'xyz'[k]}_{name}"] = accel, gyro + rng.normal(0, 8e-5 * np.sqrt(hz), u.shape)
    return sections
