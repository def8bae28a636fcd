"""The laws of thermal maps, on a soak that is made for them. N samples, d axes."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from fusion_core.chunk import Array, read_only
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import DataError, MapError, OutsideDomain
from fusion_core.testing.samples import check_refused
from fusion_core.thermal.soak_noise import blocks_of

LOW, HIGH = -10.0, 50.0
PROVENANCE = {"recordings": "soak.h5"}


def soak(d: int = 3) -> tuple[Array, Array]:
    """Return T (N,) up and down again and a bias (N, d) of 1e-3 rad/s that follows it, with noise; read-only."""
    rng = np.random.default_rng(0)
    T = np.concatenate([np.linspace(LOW, HIGH, 3000), np.linspace(HIGH, LOW, 3000)])
    bias = 1e-3 * _curves(T)[:, :d] + 1e-5 * rng.normal(size=(len(T), d))
    return read_only(T), read_only(bias)


def _curves(T: Array) -> Array:
    x = (T - 20) / 30
    return np.stack([x, x**2 - 0.3 * x, np.sin(2 * x)], axis=1)


@lru_cache(maxsize=8)
def _fitted(settings: ThermalMap, d: int = 3) -> FittedMap:
    return settings.fit(*soak(d), PROVENANCE)


def follows_the_soak(settings: ThermalMap) -> None:
    """The record says what was fitted, and most of the bias is explained; of one axis too."""
    for d in (3, 1):
        T, bias = soak(d)
        fitted = _fitted(settings, d)
        record = fitted.record
        assert (record.kind, record.d) == (settings.kind, d), f"the record is of {record.d} axes and kind {record.kind}"
        assert record.domain == (T.min(), T.max()), f"domain is {record.domain}"
        curve = fitted.bias(T)
        assert curve.shape == fitted.slope(T).shape == bias.shape, f"bias has shape {curve.shape}"
        left = np.sqrt(np.mean((bias - curve) ** 2, axis=0))
        assert np.all(left < 0.5 * np.std(bias, axis=0)), f"the fit leaves {left} rad/s of {np.std(bias, axis=0)}"
        if record.residual is not None:
            np.testing.assert_allclose(record.residual, left, rtol=1e-3, err_msg="residual is not what the fit leaves")
        assert np.all(fitted.sigma(T) >= 0), "sigma is negative"


def the_slope_is_the_derivative(settings: ThermalMap) -> None:
    """`slope` agrees with differences of `bias`."""
    fitted = _fitted(settings)
    T, h = np.linspace(LOW + 1.03, HIGH - 1.07, 301), 1e-3
    expected = (fitted.bias(T + h) - fitted.bias(T - h)) / (2 * h)
    scale = float(np.max(np.abs(expected)))
    np.testing.assert_allclose(fitted.slope(T), expected, rtol=0, atol=2e-3 * scale, err_msg="slope")


def is_the_same_after_save_and_load(settings: ThermalMap) -> None:
    """The file gives the same record, also what was added to it after the fit, and the same curve."""
    fitted, T = _fitted(settings), np.linspace(LOW, HIGH, 97)
    added = {"channel": "strain", "unit": "1", "averaged_residual": (1e-6,) * fitted.record.d, "averaged_over": 30.0}
    fitted = replace(fitted, record=fitted.record.model_copy(update=added))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{settings.suffix}"
        fitted.save(path)
        again = settings.model_copy(update={"path": path}).load()
        assert again.record == fitted.record, "the record has changed"
        np.testing.assert_allclose(again.bias(T), fitted.bias(T), rtol=1e-12, atol=0, err_msg="bias")
        np.testing.assert_allclose(again.slope(T), fitted.slope(T), rtol=1e-9, atol=1e-15, err_msg="slope")


def damaged_files_are_refused(settings: ThermalMap) -> None:
    """A file that is missing or cut short is a MapError, and one with changed bytes no other error."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{settings.suffix}"
        with_path = settings.model_copy(update={"path": path})
        check_refused(MapError, "a missing file is loaded", with_path.load)
        _fitted(settings).save(path)
        whole = path.read_bytes()
        for share in (0.0, 0.1, 0.5, 0.9):
            path.write_bytes(whole[: int(share * len(whole))])
            check_refused(MapError, f"the first {share:.0%} of a file is loaded", with_path.load)
        rng = np.random.default_rng(0)
        for _ in range(30):
            damaged = bytearray(whole)
            damaged[int(rng.integers(len(whole)))] ^= int(rng.integers(1, 256))
            path.write_bytes(damaged)
            with suppress(DataError):
                with_path.load().bias(np.array([20.0]))


def the_domain_is_kept(settings: ThermalMap) -> None:
    """Beyond the soak a map refuses, keeps the value at the end, or goes straight on, as `outside` says."""
    T = np.array([LOW - 5.0, LOW, HIGH, HIGH + 5.0])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{settings.suffix}"
        _fitted(settings).save(path)
        refusing, clamped, straight = (
            settings.model_copy(update={"outside": outside}).read(path) for outside in ("refuse", "clamp", "tangent")
        )
    check_refused(OutsideDomain, "outside: refuse gives a bias beyond the domain", refusing.bias, T)
    bias, slope = clamped.bias(T), clamped.slope(T)
    np.testing.assert_array_equal(bias[[0, 3]], bias[[1, 2]], err_msg="outside: clamp moves beyond the domain")
    assert not np.any(slope[[0, 3]]), "outside: clamp has a slope beyond the domain"
    bias, slope = straight.bias(T), straight.slope(T)
    np.testing.assert_allclose(bias[3] - bias[2], 5 * slope[2], rtol=1e-9, atol=1e-15, err_msg="outside: tangent")
    np.testing.assert_allclose(bias[1] - bias[0], 5 * slope[1], rtol=1e-9, atol=1e-15, err_msg="outside: tangent")


def samples_that_cannot_be_fitted_are_refused(settings: ThermalMap) -> None:
    """A soak that does not move, is empty, or has a NaN is a DataError."""
    T, bias = (values.copy() for values in soak())
    cases = {"no swing": (np.full(len(T), 20.0), bias), "no sample": (T[:0], bias[:0])}
    for where in (T, bias):
        where.flat[7] = np.nan
    cases["a NaN"] = (T, bias)
    for what, samples in cases.items():
        check_refused(DataError, f"a soak with {what} is fitted", settings.fit, *samples, PROVENANCE)


def the_basis_can_be_fitted(settings: ThermalMap) -> None:
    """`basis` gives finite curves (N, q), and a penalty (q, q) that is symmetric and not negative."""
    basis = settings.basis((LOW, HIGH))
    T = np.linspace(LOW, HIGH, 400)
    values, penalty = basis.values(T), basis.penalty
    q = values.shape[1]
    assert values.shape == (400, q), f"values have shape {values.shape}"
    assert penalty.shape == (q, q), f"penalty has shape {penalty.shape}"
    assert np.all(np.isfinite(values)), "values are not finite"
    np.testing.assert_allclose(penalty, penalty.T, err_msg="penalty")
    assert np.min(np.linalg.eigvalsh(penalty)) >= -1e-9 * max(float(np.max(penalty)), 1e-300), "penalty is negative"


def it_answers_to_noise(settings: ThermalMap) -> None:
    """`smoother` gives a finite answer (G, K) to the noise of K blocks, and takes a constant for what it is."""
    T, bias = soak()
    blocks, grid = blocks_of(T, bias), np.linspace(LOW, HIGH, 31)
    smoother = settings.smoother(T, bias)
    for axis in range(bias.shape[1]):
        H = smoother(blocks, grid, axis)
        assert H.shape == (31, len(blocks.T)), f"the answer has shape {H.shape}"
        assert np.all(np.isfinite(H)), "the answer is not finite"
        np.testing.assert_allclose(H.sum(axis=1), 1.0, atol=0.01, err_msg="the answer to a constant")


def follows_a_curve_that_is_known(settings: ThermalMap) -> None:
    """`from_curve` gives the curve that a fit to its points would have, and the record that it was given."""
    T = np.linspace(LOW, HIGH, 2001)
    curve = 1e-3 * _curves(T)[:, :2]
    record = _fitted(settings, 1).record.model_copy(update={"axes": ("x", "y"), "residual": None, "error": None})
    fitted = settings.from_curve(T, curve, record)
    assert fitted.record == record, "the record has changed"
    left = np.std(curve - fitted.bias(T), axis=0)
    limit = np.std(curve - settings.fit(T, curve, {}).bias(T), axis=0) + 1e-6 * np.std(curve, axis=0)
    assert np.all(left <= 1.01 * limit), f"the curve is left by {left} rad/s, a fit leaves {limit}"
