"""Maps of soaks that were measured."""

import numpy as np
import pytest
from soaks import ALL, DEG_H, kinds

REFERENCE = {(2, 3): [23, 25, 25], (3, 2): [35, 21, 23]}  # of an independent fit, deg/h


@pytest.fixture(scope="module")
def heating(recordings):
    folder, runs = recordings / "data" / "rtimulib2_teensy", {}
    for k in (2, 3):
        table = np.genfromtxt(folder / f"measurements{k}.csv", delimiter=",", names=True)
        table = table[table["ok"] == 1]
        runs[k] = table["temp_C"], np.stack([table[f"g{axis}_rad_s"] for axis in "xyz"], axis=1)
    return runs


def block_rms(T, bias, found):
    """Rms of means of 25 rows, constant removed, deg/h: a row's noise is 85 to 130 deg/h, a mean's 16 to 27."""
    left = bias - found.bias(T)
    left -= left.mean(axis=0)
    n = len(left) // 25
    return DEG_H * np.std(left[: n * 25].reshape(n, 25, 3).mean(axis=1), axis=0)


@pytest.mark.recordings
@pytest.mark.parametrize(("on", "to"), REFERENCE)
@kinds
def test_a_map_carries_over_to_another_run_of_the_same_board(maps, on, to, heating):
    """A stiff map leaves noise. Run 2 has a wave of 45 deg/h in x that run 3 has not, so a map that is
    supple enough to follow it carries it over: there the two others are bounded more loosely."""
    found = maps.fit(*heating[on], {})
    T, bias = heating[to]
    inside = (found.domain[0] <= T) & (found.domain[1] >= T)
    margin = 1.1 if maps.kind == "polynomial" else np.where([on == 2, False, False], 1.6, 1.15)
    assert np.all(block_rms(T[inside], bias[inside], found) <= margin * np.array(REFERENCE[on, to]))


@pytest.mark.recordings
@pytest.mark.parametrize("run", [2, 3])
@pytest.mark.parametrize("maps", ALL[1:], ids=lambda maps: maps.kind)
def test_a_supple_map_leaves_only_noise_on_its_own_run(maps, run, heating):
    T, bias = heating[run]
    noise = np.std(np.diff(bias, axis=0), axis=0) / np.sqrt(2) / np.sqrt(25) * DEG_H  # of a mean, if it is white
    assert np.all(block_rms(T, bias, maps.fit(T, bias, {})) < 1.35 * noise)
