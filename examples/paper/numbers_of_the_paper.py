"""The paper's tables 5 to 12 (Fontanella et al., Sensors 18 (2018) 1457): standard filter, then TCZUPT; x, y, z."""

PAPER = {
    "residual of the 30 s average (table 5)": ([1.68e-6, 2.98e-6, 3.43e-6], [9.53e-6, 6.80e-6, 1.03e-5]),
    "nominal, first 30 s (table 6)": ([1.24e-5, 3.17e-5, 2.11e-5], [3.78e-5, 3.46e-5, 7.88e-6]),
    "nominal, whole interval (table 6)": ([4.15e-5, 7.48e-5, 6.07e-5], [5.33e-5, 2.97e-5, 3.30e-5]),
    "15 deg/h, first 30 s (table 7)": ([6.66e-5, 5.07e-5, 1.01e-4], [4.09e-5, 4.60e-5, 8.16e-5]),
    "15 deg/h, whole interval (table 7)": ([3.98e-5, 9.72e-5, 8.17e-5], [4.13e-5, 3.88e-5, 3.01e-5]),
    "nominal, five segments, mean (table 9)": ([3.42e-5, 3.58e-5, 4.36e-5], [4.70e-5, 2.63e-5, 3.89e-5]),
    "15 deg/h, five segments, mean (table 11)": ([6.49e-5, 8.88e-5, 7.16e-5], [3.81e-5, 4.58e-5, 3.36e-5]),
    "15 deg/h, time to 1e-5 rad/s in s (table 12)": ([140.0, 345.0, 85.0], [65.0, 127.0, 53.0]),
}
