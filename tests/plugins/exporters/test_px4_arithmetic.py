"""PX4's arithmetic: bit for bit that of its formula in C, and its module's way of publishing."""

import subprocess

import numpy as np
import pytest
from flying_units import in_c

from fusion_plugins.exporters.px4 import Px4Parameters, published

# documentation of the parameters: delta = T - TREF, T clipped to TMIN and TMAX; offset = X0 + X1 delta + X2 delta^2 ...
FORMULA = """
static float f(const float *c, float T) {  /* T_ref, T_min, T_max, X0 to X3 */
  float d = (T > c[2] ? c[2] : T < c[1] ? c[1] : T) - c[0];
  float d2 = d * d, d3 = d2 * d;
  return c[3] + c[4] * d + c[5] * d2 + c[6] * d3;
}
"""
FIFTH = """
static float f(const float *c, float T) {  /* T_ref, T_min, T_max, X0 to X5 */
  float d = (T > c[2] ? c[2] : T < c[1] ? c[1] : T) - c[0], power = d, y = c[3] + c[4] * d;
  for (int i = 5; i < 9; i++) { power *= d; y += c[i] * power; }
  return y;
}
"""


@pytest.fixture
def T():
    return np.random.default_rng(2).uniform(-40, 90, 100_000).astype(np.float32)


@pytest.mark.parametrize(("body", "n"), [(FORMULA, 4), (FIFTH, 6)])
def test_offsets_are_those_of_the_formula_in_c_to_the_bit(body, n, T, tmp_path):
    rng = np.random.default_rng(n)
    X = (rng.normal(size=(n, 1)) * 10.0 ** -np.arange(2, 2 + n)[:, None]).astype(np.float32)
    T_ref, low, high = np.float32([21.3, -12.7, 61.9])
    found = Px4Parameters(X, T_ref, low, high).bias(T)
    expected = in_c(tmp_path, body, [T_ref, low, high, *X[:, 0]], T)
    assert np.array_equal(found[:, 0].view(np.uint32), expected.view(np.uint32))


def test_it_is_published_when_the_temperature_has_moved_by_more_than_a_kelvin():
    t = np.arange(9.0)
    T = [20.0, 20.9, 21.0, 21.1, 21.5, 20.2, 20.05, 20.0, 19.0]
    # 21.0 is exactly one kelvin away, which is not more
    assert published(t, T).tolist() == np.float32([20, 20, 20, 21.1, 21.1, 21.1, 20.05, 20.05, 19.0]).tolist()


def test_it_looks_once_a_second_whatever_the_rate_of_the_samples():
    t = np.arange(0, 60, 0.01)
    T = 20 + 0.7 * t
    used = published(t, T)
    changes = np.flatnonzero(np.diff(used)) + 1
    np.testing.assert_allclose(t[changes] % 2, 0, atol=1e-9)  # 1.4 K in two looks, 0.7 K in one
    assert np.array_equal(used[changes], T[changes].astype(np.float32))


def test_what_is_used_lags_by_no_more_than_a_kelvin_and_what_a_second_brings():
    t = np.arange(3601.0)
    T = 50 - 60 * np.exp(-t / 900)
    assert np.max(np.abs(published(t, T) - T)) <= 1 + 60 / 900


def test_a_start_at_the_value_of_nothing_published_takes_nothing_away():
    # -100 degC stands for `never`: within a kelvin of it nothing is ever published; no sensor is that cold
    assert published(np.arange(3.0), [-99.5, -99.6, -40.0]).tolist() == [-100.0, -100.0, -40.0]


# the module of the documentation, for COUNT sensors: once a second each offset is worked out; where the temperature of
# one has moved by more than 1 K since that one was last reported, what is worked out of all is published
MODULE = """
#include <math.h>
#include <stdio.h>
int main(void) {
  float T[COUNT], offset[COUNT], out[COUNT] = {0}, last[COUNT];
  for (int i = 0; i < COUNT; i++) last[i] = -100.0f;
  while (fread(T, sizeof T, 1, stdin) == 1) {
    int changed = 0;
    for (int i = 0; i < COUNT; i++) {
      offset[i] = 0.25f + 0.5f * T[i];
      if (fabsf(T[i] - last[i]) > 1.0f) { last[i] = T[i]; changed = 1; }
    }
    if (changed) for (int i = 0; i < COUNT; i++) out[i] = offset[i];
    fwrite(out, sizeof out, 1, stdout);
  }
  return 0;
}
"""


@pytest.mark.parametrize("count", [1, 2, 6])
def test_what_is_published_of_several_sensors_is_what_the_module_publishes_in_c(count, tmp_path):
    rng = np.random.default_rng(count)
    walk = np.cumsum(rng.normal(0, 0.2, (2000, count)), axis=0)
    T = (20 + 3 * np.arange(count) + walk).astype(np.float32)
    (tmp_path / "module.c").write_text(MODULE)
    flags = ["-std=c99", "-O1", "-ffp-contract=off", f"-DCOUNT={count}"]
    subprocess.run(["gcc", *flags, "-o", tmp_path / "module", tmp_path / "module.c", "-lm"], check=True)
    done = subprocess.run([tmp_path / "module"], input=T.tobytes(), capture_output=True, check=True)
    expected = np.frombuffer(done.stdout, dtype=np.float32).reshape(-1, count)
    for k in range(count):
        used = published(np.arange(2000.0), T[:, k], list(T.T))
        found = np.float32(0.25) + np.float32(0.5) * used
        assert np.array_equal(found.view(np.uint32), np.ascontiguousarray(expected[:, k]).view(np.uint32))
