"""Epochs of a unit at rest, drawn one by one without integrating samples; shares nothing with the filter."""

import numpy as np

from fusion_core.chunk import Chunk

GYRO_NOISE, ACCEL_NOISE = 1.5417e-5, 8.333e-4  # 3.18 deg/h/sqrt(Hz) in rad/s/sqrt(Hz), 0.05 m/s/sqrt(h) in m/s/sqrt(s)
DEG_H = np.deg2rad(1) / 3600  # rad/s
G = 9.80206  # m/s^2 at 40.9 deg by the tables of WGS 84


def epochs_at_rest(t, tau, *, seed=0, noisier=1.0, bias=0.0, gyro_step=0.0, accel_step=0.0):
    """Return epochs that end at t (N,) and lasted tau (N,): white noise, a bias, and each reading rounded to steps."""
    rng = np.random.default_rng(seed)
    shape = (len(t), 3)
    tau = np.broadcast_to(tau, len(t)).astype(float)
    white = noisier / np.sqrt(tau)[:, None]
    gyro = np.array([2e-3, -1e-3, 5e-4]) + bias + rng.normal(size=shape) * GYRO_NOISE * white
    accel = np.array([0.02, -0.03, G]) + rng.normal(size=shape) * ACCEL_NOISE * white
    if gyro_step:
        gyro = np.round(gyro / gyro_step) * gyro_step
    if accel_step:
        accel = np.round(accel / accel_step) * accel_step
    channels = {"gyro": gyro, "accel": accel, "tau": tau}
    return Chunk(t, channels, Chunk(t[:1] - tau[:1], {name: values[:1] for name, values in channels.items()}))
