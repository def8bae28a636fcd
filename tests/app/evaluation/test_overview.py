"""A file gathered block by block gives what the whole arrays give."""

import h5py
import numpy as np
import pytest
import scipy.stats
from units_at_rest import unit_at_rest

from driftlab.commands.estimates import estimates_file
from driftlab.config import Config
from driftlab.evaluation.overview import POINTS, OverviewAccumulator
from driftlab.evaluation.scores import moving_average, score
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk

FILTER = {
    "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
    "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return a run with a knock and a gap in it: its model, its journal, its stretches, and its file."""
    config = Config.model_validate({"latitude": "40.9 deg", "heading": "0 deg", "filter": FILTER})
    unit = unit_at_rest(seconds=900)
    unit.gyro[6000:6040] += 0.3
    keep = np.ones(len(unit.t), bool)
    keep[9000:9600] = False
    samples = Chunk(unit.t, unit.channels()).where(keep)
    journal, path = RunLog(), tmp_path_factory.mktemp("run") / "estimates.h5"
    run = Run(config, journal)
    stretches = list(run.over(epochs([samples], 0.1)))
    file = estimates_file(path, run.model, {})
    for stretch in stretches:
        file.append(stretch.columns())
    file.close()
    with h5py.File(path) as file:
        whole = {name: data[:] if data.dtype == bool else data[:].astype(float) for name, data in file.items()}
    for name, values in joined(stretches).items():
        np.testing.assert_allclose(whole[name], values, rtol=1e-7)  # some are kept in single precision
    return run.model, journal, whole, path


def survey(path, model, alignment, rows):
    with h5py.File(path) as file:
        return OverviewAccumulator(model, alignment, rows=rows).read(file).overview()


@pytest.mark.parametrize("rows", [97, 1000, 65_536])
def test_survey_is_what_the_whole_arrays_give(finished, rows):
    model, journal, whole, path = finished
    first = journal.alignments[0]
    found = survey(path, model, first, rows)
    expected = score(whole, first.up, model.tracked.axes)
    np.testing.assert_allclose(found.yardsticks.filter_first, expected.filter_first, rtol=1e-9)
    np.testing.assert_allclose(found.yardsticks.filter_whole, expected.filter_whole, rtol=1e-9)
    for name, value in expected.coast.items():
        np.testing.assert_allclose(found.yardsticks.coast[name], value, rtol=1e-9)
        np.testing.assert_allclose(found.yardsticks.coast_sigma[name], expected.coast_sigma[name], rtol=1e-9)
        np.testing.assert_allclose(found.yardsticks.heading[name], expected.heading[name], rtol=1e-9)
    assert np.isfinite(expected.heading["10 min"])
    assert found.yardsticks.share == pytest.approx(expected.share)
    assert found.yardsticks.moved == pytest.approx(expected.moved)
    assert 0 < expected.moved < 0.01
    after = whole["used"] & (whole["t"] > first.t)
    assert 0 < np.sum(~whole["used"]) < 100
    assert found.nis.mean == pytest.approx(np.mean(whole["nis"][after]) / model.m)
    white = whole["white"][after] - whole["white"][after].mean(axis=0)
    rho = np.array([np.sum(white[k:] * white[:-k], axis=0) for k in range(1, 21)]) / np.sum(white**2, axis=0)
    N = len(white)
    statistic = N * (N + 2) * np.sum(rho**2 / (N - np.arange(1, 21))[:, None], axis=0)
    np.testing.assert_allclose(found.whiteness_p, scipy.stats.chi2.sf(statistic, 20), rtol=1e-6)


def test_survey_keeps_the_reference_and_few_rows_for_the_figures(finished):
    model, journal, whole, path = finished
    found = survey(path, model, journal.alignments[0], 500)
    reference = moving_average(whole["t"], whole["rate"], whole["tau"], whole["still"])
    rows = np.searchsorted(whole["t"], found.curves["t"])
    assert POINTS / 2 <= len(rows) <= POINTS
    assert rows[-1] == len(whole["t"]) - 1
    np.testing.assert_array_equal(whole["t"][rows], found.curves["t"])
    np.testing.assert_allclose(found.curves["reference"], reference[rows], rtol=0, atol=1e-15)
    assert 0 < np.sum(np.isnan(found.curves["reference"][:, 0])) < 50  # where it moved
    with h5py.File(path) as file:
        np.testing.assert_array_equal(found.bias, file["bias"][-1])
    assert found.count == len(whole["t"])
    assert found.used == np.sum(whole["used"])
    used = whole["used"] & (whole["t"] > journal.alignments[0].t)
    assert np.sum(found.nis_curve[:, 1]) / len(found.nis_curve) == pytest.approx(np.mean(whole["nis"][used]), rel=0.02)


def test_what_goes_by_in_pieces_of_any_size_gives_what_is_read_back(finished):
    model, journal, whole, path = finished
    gathered, at, sizes = OverviewAccumulator(model, journal.alignments[0], rows=1000), 0, (1, 16, 333, 2000)
    while at < len(whole["t"]):
        size = sizes[at % len(sizes)]
        gathered.add({name: values[at : at + size] for name, values in whole.items()})
        at += size
    found, read = gathered.overview(), survey(path, model, journal.alignments[0], 65_536)
    assert (found.count, found.used, found.start, found.end) == (read.count, read.used, read.start, read.end)
    for name in ("coast", "coast_sigma"):
        for horizon, value in getattr(read.yardsticks, name).items():
            np.testing.assert_allclose(getattr(found.yardsticks, name)[horizon], value, rtol=1e-9)
    for name in ("curves", "errors"):
        for column, values in getattr(read, name).items():
            np.testing.assert_allclose(getattr(found, name)[column], values, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.nis_curve, read.nis_curve, rtol=1e-12)
    np.testing.assert_allclose(found.whiteness_p, read.whiteness_p, rtol=1e-6)
    assert found.swing == read.swing == np.ptp(whole["temperature"])
