"""The generic core: an augmented-state Kalman filter and the host of the plugins that describe its states.

Conventions, written here once and used everywhere:

- Time is always the leading axis. N samples, n states, m measured components, d axes.
- One step leads *to* sample k; with the known drift u, the noise w ~ N(0, Q) and r ~ N(0, R)::

      x_k = F_k x_{k-1} + u_k + w_k
      z_k = H_k x_k + r_k

- A leading N may be left out of F, Q, H, R: "the same for every sample". That is how the core knows
  that a model is time-invariant.
- y = z - H x is the innovation, S its covariance, K the gain, nis = y' S^-1 y.
- Everything is in SI units, temperatures in degC; `sigma_*` are standard deviations or densities.

The core knows arrays, chunks, blocks and plugins. It knows no gyro and no temperature.
"""
