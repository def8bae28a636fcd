"""An ArduPilot vehicle's corrections of a sample before it is logged, in float32 as its firmware has it.

Written from the formulas of AP_InertialSensor_Backend.cpp, AP_InertialSensor_tempcal.cpp and vector3.cpp of ArduPilot,
and from nothing of the program's.
"""

import numpy as np

f32 = np.float32
HALF_SQRT_2 = f32(0.70710678118654757)


def _yaw_45(x, y, z):
    return HALF_SQRT_2 * (x - y), HALF_SQRT_2 * (x + y), z


def _roll_90_pitch_68_yaw_293(x, y, z):
    return (
        f32(0.143039) * x + f32(0.368776) * y - f32(0.918446) * z,
        f32(-0.332133) * x - f32(0.856289) * y - f32(0.395546) * z,
        f32(-0.932324) * x + f32(0.361625) * y,
    )


TURNS = {
    0: lambda x, y, z: (x, y, z),
    1: _yaw_45,
    2: lambda x, y, z: (-y, x, z),
    4: lambda x, y, z: (-x, -y, z),
    6: lambda x, y, z: (y, -x, z),
    8: lambda x, y, z: (x, -y, -z),
    10: lambda x, y, z: (y, x, -z),
    12: lambda x, y, z: (-x, y, -z),
    16: lambda x, y, z: (x, -z, y),
    18: lambda x, y, z: (z, x, y),
    20: lambda x, y, z: (x, z, -y),
    24: lambda x, y, z: (z, y, -x),
    25: lambda x, y, z: (-z, y, x),
    38: _roll_90_pitch_68_yaw_293,
    41: lambda x, y, z: (f32(0.992546152) * x + f32(0.121869343) * z, y, f32(-0.121869343) * x + f32(0.992546152) * z),
    42: lambda x, y, z: (x, HALF_SQRT_2 * (y - z), HALF_SQRT_2 * (y + z)),
}
"""Vector3::rotate by the number of AHRS_ORIENTATION."""


def polynomial(t, coefficients):
    t = f32(t)[..., None] if np.ndim(t) else f32(t)
    c = coefficients.astype(f32)
    return (c[0] + (c[1] + c[2] * t) * t) * t * f32(1.0e-6)


def logged(v, T, *, orientation=0, offset=(0, 0, 0), scale=(1, 1, 1), tcal=None):
    """Return samples v (N, 3) as the vehicle logs them; `tcal` is (T_min, T_max, T_cal, coefficients (3, 3))."""
    v = v.astype(f32)
    if tcal is not None:
        low, high, at, coefficients = tcal
        v = v - polynomial(np.clip(T.astype(f32), f32(low), f32(high)) - f32(35), coefficients)
        v = v + polynomial(np.clip(f32(at), f32(low), f32(high)) - f32(35), coefficients)
    v = (v - np.array(offset, f32)) * np.array(scale, f32)
    return np.stack(TURNS[orientation](*v.T), axis=1)


def parameters(sensor, k=0, *, orientation=0, offset=(0, 0, 0), scale=None, tcal=None):
    """Return the same as parameters of the k-th inertial unit, from 0; `sensor` is GYR or ACC."""
    n = k + 1
    if k < 3:
        first = {"GYR": "INS_GYROFFS", "ACC": "INS_ACCOFFS"}[sensor]
        names = (first if k == 0 else f"INS_{sensor}{n}OFFS", "INS_ACCSCAL" if k == 0 else f"INS_ACC{n}SCAL")
        at, head = f"INS_{sensor}{n}_CALTEMP", f"INS_TCAL{n}"
    else:
        names = (f"INS{n}_{ {'GYR': 'GYROFFS', 'ACC': 'ACCOFFS'}[sensor] }", f"INS{n}_ACCSCAL")
        at, head = f"INS{n}_{sensor}_CALTEMP", f"INS{n}_TCAL"
    values = {"AHRS_ORIENTATION": orientation, f"{head}_ENABLE": 0 if tcal is None else 1}
    values |= {f"{names[0]}_{axis}": offset[j] for j, axis in enumerate("XYZ")}
    if scale is not None:
        values |= {f"{names[1]}_{axis}": scale[j] for j, axis in enumerate("XYZ")}
    if tcal is not None:
        low, high, T_cal, coefficients = tcal
        values |= {f"{head}_TMIN": low, f"{head}_TMAX": high, at: T_cal}
        for order in (1, 2, 3):
            for j, axis in enumerate("XYZ"):
                values[f"{head}_{sensor}{order}_{axis}"] = coefficients[order - 1, j]
    return values
