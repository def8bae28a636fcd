"""Begin and end of every fit of a map: checks of the samples, and the record of the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import BadValue, EmptyRecording, SwingTooSmall
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.fitted_map import MapRecord
from fusion_core.thermal.record_texts import recorded

SLAB = 1 << 16  # samples handled at a time, so that millions need no memory of their own


def check_samples(kind: str, T: Array, bias: Array) -> tuple[Array, Array]:
    """Return T (N,) and bias (N, d) as arrays of float64.

    Raises
    ------
    BadValue
        If the shapes do not match, or a value is not a finite number.
    EmptyRecording
        If there are no samples.
    """
    T, bias = np.asarray(T, dtype=np.float64), np.asarray(bias, dtype=np.float64)
    if T.ndim != 1 or bias.ndim != 2 or len(T) != len(bias) or bias.shape[1] == 0:
        raise BadValue(
            f"{kind}: has T {T.shape} and bias {bias.shape}, expected (N,) and (N, d); "
            f"give one row of bias a temperature"
        )
    if len(T) == 0:
        raise EmptyRecording(f"{kind}: has no sample to fit; check the recording and its START:STOP range")
    for name, values in (("T", T[:, None]), ("bias", bias)):
        good = np.isfinite(values).all(axis=1)
        if not good.all():
            k = int(np.argmin(good))
            raise BadValue(
                f"{kind}: {name} has {np.sum(~good)} samples that are not finite numbers, the first is "
                f"sample {k} of {len(T)}, expected none; leave those rows out before the fit"
            )
    return T, bias


def check_swing(kind: str, T: Array, min_swing: float, distinct: int, what: str, remedy: str) -> None:
    """Raise SwingTooSmall where T (N,) moves less than `min_swing` K or takes too few `distinct` values."""
    swing, values = float(np.ptp(T)), len(np.unique(T))
    if swing < min_swing:
        raise SwingTooSmall(
            f"{kind}: T moves by only {swing:.2f} K, {what} needs at least {min_swing:g} K; "
            f"fit it on a wider soak or lower min_swing"
        )
    if values < distinct:
        raise SwingTooSmall(
            f"{kind}: T takes only {values} distinct values, {what} needs at least {distinct}; "
            f"fit it on a wider soak or {remedy}"
        )


def record_of(
    kind: str,
    T: Array,
    bias: Array,
    predict: Callable[[Array], Array],
    provenance: Mapping[str, str],
    *,
    resolution: float = 0.0,
    dither: float = 0.0,
    error: CurveError | None = None,
) -> MapRecord:
    """Return the record of a fit.

    Parameters
    ----------
    kind : str
        Of the map.
    T, bias : (N,) and (N, d) arrays
        The samples, in degC and rad/s.
    predict : function of T (N,) -> (N, d)
        The curve that was fitted. The record has the rms over all samples of what it leaves.
    provenance : mapping of str to str
        As `ThermalMap.fit` got it.
    resolution, dither : float
        Steps of the thermometer and its noise before them in K (`steps_of`); 0 where none are seen.
    error : CurveError or None
        How far the curve may be off; None where the kind does not tell, and the residual stands for it.
    """
    total = np.zeros(bias.shape[1])
    for start in range(0, len(T), SLAB):
        part = slice(start, start + SLAB)
        total += np.sum((bias[part] - predict(T[part])) ** 2, axis=0)
    return MapRecord(
        kind=kind,
        domain=(float(T.min()), float(T.max())),
        residual=tuple(np.sqrt(total / len(T)).tolist()),
        samples=len(T),
        provenance=recorded(provenance),
        resolution=resolution,
        dither=dither,
        error=error,
    )
