import numpy as np
import pytest
from pydantic import ValidationError

from fusion_core.contracts import CurveError, MatrixCurve, ThermalMap, TriadMatrix
from fusion_core.host.registry import registry

CUBIC = np.random.default_rng(0).normal(0, 2e-3, (4, 9))  # coefficients of x^0 to x^3


def cubic(T):
    x = (np.asarray(T)[:, None] - 20) / 40
    return sum(c * x**k for k, c in enumerate(CUBIC)), sum(k * c * x ** max(k - 1, 0) / 40 for k, c in enumerate(CUBIC))


def matrix_with(**fields):
    T = np.array([-20.0, 5.0, 60.0])
    values, slopes = cubic(T)
    error = CurveError(T=(-20.0, 60.0), modes=(((1e-4,) * 9, (2e-4,) * 9),), bend=(0.0,) * 9)
    given = {"T": T.tolist(), "values": values.tolist(), "slopes": slopes.tolist(), "frame": "given",
             "kinds": ("order 3",) * 9, "told": (True,) * 9, "error": error}  # fmt: skip
    return TriadMatrix(**given | fields)


def test_a_cubic_is_held_exactly():
    T = np.linspace(-20, 60, 57)
    np.testing.assert_allclose(matrix_with().terms(T), cubic(T)[0], rtol=0, atol=1e-16)


def test_sigma_is_that_of_the_modes():
    np.testing.assert_allclose(matrix_with().sigma(np.array([-20.0, 20.0, 60.0]))[:, 4], [1e-4, 1.5e-4, 2e-4])


def test_a_map_gives_back_the_input_of_readings(tmp_path):
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})
    T = np.linspace(-20, 60, 200)
    bias = np.outer(T, [1e-4, -2e-4, 3e-4])
    fitted = settings.fit(T, bias, {}).noting(matrix=matrix_with())
    u = np.random.default_rng(1).normal(size=(200, 3))
    y = u + np.einsum("nij,nj->ni", cubic(T)[0].reshape(-1, 3, 3), u) + bias
    np.testing.assert_allclose(fitted.corrected(y, T), u, rtol=0, atol=1e-14)

    fitted.save(tmp_path / "map.json")
    again = settings.read(tmp_path / "map.json")
    np.testing.assert_array_equal(again.corrected(y, T), fitted.corrected(y, T))
    assert not np.any(fitted.noting(matrix=None).distortion(y, T))


def test_the_strain_of_a_gyro_is_taken_off_where_the_force_is_known(tmp_path):
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})
    T, rng = np.linspace(-20, 60, 200), np.random.default_rng(1)
    bias, u, f = np.outer(T, [1e-4, -2e-4, 3e-4]), rng.normal(size=(200, 3)), rng.normal(0, 9, (200, 3))
    M, G = cubic(T)[0].reshape(-1, 3, 3), 0.1 * cubic(T)[0].reshape(-1, 3, 3)
    fields = matrix_with().model_dump(exclude={"frame"})
    fields |= {name: 0.1 * np.array(fields[name]) for name in ("values", "slopes")}
    held = MatrixCurve.model_validate({**fields, **{n: fields[n].tolist() for n in ("values", "slopes")}})
    for matrix, part in ((matrix_with(), np.einsum("nij,nj->ni", M, u)), (None, 0.0)):
        fitted = settings.fit(T, bias, {}).noting(matrix=matrix, sensitivity=held)
        y = u + part + bias + np.einsum("nij,nj->ni", G, f)
        np.testing.assert_allclose(fitted.corrected(y, T, force=f), u, rtol=0, atol=1e-14)
        assert np.max(np.abs(fitted.corrected(y, T) - u)) > 1e-3  # the force is not known: the strain stays
        fitted.save(tmp_path / "map.json")
        again = settings.read(tmp_path / "map.json")
        np.testing.assert_array_equal(again.corrected(y, T, force=f), fitted.corrected(y, T, force=f))


def test_beyond_the_domain_the_matrix_is_that_of_its_end():
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"order": 1, "outside": "clamp"})
    T = np.linspace(-20, 60, 200)
    fitted = settings.fit(T, np.outer(T, [1e-4, -2e-4, 3e-4]), {}).noting(matrix=matrix_with())
    y, ends = np.ones((2, 3)), np.array([-20.0, 60.0])
    np.testing.assert_array_equal(fitted.corrected(y, np.array([-30.0, 90.0])), fitted.corrected(y, ends))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"T": (0.0, 0.0, 1.0)}, "do not rise"),
        ({"values": ((0.0,) * 8,) * 3}, "shape"),
        ({"told": (True,) * 3}, "9 terms"),
        ({"values": ((0.6,) + (0.0,) * 8,) * 3}, "adds up to 0.6"),
    ],
)
def test_a_matrix_that_is_none_is_refused(fields, message):
    with pytest.raises(ValidationError, match=message):
        matrix_with(**fields)


def test_a_map_of_one_axis_has_no_matrix():
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"order": 1})
    T = np.linspace(-20, 60, 200)
    with pytest.raises(ValidationError, match="a triad has three"):
        settings.fit(T, 1e-4 * T[:, None], {}).noting(matrix=matrix_with())
