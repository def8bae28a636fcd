"""Passes over partitions: whoever works on them, the sums are the same to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import other_families as made
import pytest
from numpy.testing import assert_allclose
from threadpoolctl import threadpool_limits

from driftlab.family import mixed_model, outlier_tests, partitions
from driftlab.family.band_calibration import measure_bands
from driftlab.family.mixed_model import Family, fit_family
from driftlab.family.partitions import InMemory, Partitions, added, in_partitions, tree
from driftlab.family.reml import UnitsUnderLaw, VarianceComponents, e_step
from driftlab.production.workers import Pool

SIZE = 1e-4


@pytest.fixture(scope="module")
def units() -> list[partitions.UnitOfLot]:
    dealt = made.deal("polynomial", 60, 31, d=2, lots=3, size=SIZE)
    return [(unit.soaked(31, ("x", "y")), unit.lot) for unit in dealt]


def test_a_tree_adds_in_an_order_that_whole_branches_do_not_change(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    for count in (1, 2, 3, 7, 22, 64, 91):
        leaves = (rng.normal(size=count) * 10.0 ** rng.integers(-8, 8, count)).tolist()
        parts = Partitions([InMemory(leaf, 1) for leaf in leaves])
        sums = set()
        for blocks in (1, 2, 5, 16, 1000):
            monkeypatch.setattr(partitions, "BLOCKS", blocks)
            sums.add(tree(parts.map(float)))
        assert sums == {tree(leaves)}
        assert_allclose(sums.pop(), float(np.sum(np.array(leaves, dtype=np.longdouble))), rtol=1e-12)


def test_results_are_added_by_what_they_are() -> None:
    one = (np.array([1.0, 2.0]), ["a"], {"L0": (1, [3])})
    other = (np.array([10.0, 20.0]), ["b", "c"], {"L1": (5, [6]), "L0": (2, [4])})
    total = added(one, other)
    assert total[0].tolist() == [11.0, 22.0]
    assert total[1:] == (["a", "b", "c"], {"L0": (3, [3, 4]), "L1": (5, [6])})


def test_partitions_of_units_have_their_part_of_what_is_sent(units: list[partitions.UnitOfLot]) -> None:
    parts = in_partitions(units, 7)
    names = [soaked.unit for soaked, _ in units]
    found = [pair for own in parts.map(_with_names, names, np.arange(60)) for pair in own]
    assert found == [(name, name, k) for k, name in enumerate(names)]
    some = parts.chosen([59, 3, 8, 9, 22], 2)
    assert [[soaked.unit for soaked, _ in part.read()] for part in some.parts] == [
        [names[3], names[8]], [names[9], names[22]], [names[59]],
    ]  # fmt: skip
    assert [soaked.unit for soaked, _ in some.read()] == [names[k] for k in (3, 8, 9, 22, 59)]


class _Counted(list[partitions.UnitOfLot]):
    """Units that are read one by one, and know which."""

    read: list[str]

    def __getitem__(self, k: int) -> partitions.UnitOfLot:  # type: ignore[override]
        unit = super().__getitem__(k)
        self.read.append(unit[0].unit)
        return unit


def test_of_units_that_are_chosen_among_chosen_ones_no_others_are_read(units: list[partitions.UnitOfLot]) -> None:
    contents = [_Counted(units[k : k + 7]) for k in range(0, 60, 7)]
    read: list[str] = []
    for content in contents:
        content.read = read
    parts = Partitions([InMemory(content, len(content)) for content in contents])
    some = parts.chosen(range(0, 60, 3), 8).chosen([1, 9, 10], 2)
    assert [len(part) for part in some.parts] == [2, 1]
    assert read == []
    expected = [units[k][0].unit for k in (3, 27, 30)]
    assert [soaked.unit for soaked, _ in some.read()] == expected == read


def _with_names(own: list[partitions.UnitOfLot], names: list[str], places: np.ndarray) -> list[tuple[str, str, int]]:
    return [(soaked.unit, name, int(k)) for (soaked, _), name, k in zip(own, names, places, strict=True)]


def _found(units: Partitions[list[partitions.UnitOfLot]], sample: int) -> tuple[Family, np.ndarray]:
    with pytest.MonkeyPatch.context() as patched:  # here alone: what workers fit is of fewer
        patched.setattr(mixed_model, "SAMPLE", sample)
        family = fit_family(units)
    family = family.model_copy(update={"bands": measure_bands(family, units)})
    statistics = outlier_tests.CurveStatistics(family, fitted=True)
    return family, outlier_tests.tests_of(family, statistics, units, [], None).curves


@pytest.mark.parametrize("sample", [1500, 40])  # all units, and some of them
def test_processes_change_nothing(sample: int, units: list[partitions.UnitOfLot], tmp_path: Path) -> None:
    with threadpool_limits(1):
        family, values = _found(in_partitions(units, 7), sample)
        with Pool(2) as pool:
            theirs = replace(in_partitions(units, 7), engine=pool.ordered, scratch=partitions.ScratchFolder(tmp_path))
            by_two, of_two = _found(theirs, sample)
    assert by_two.model_dump_json() == family.model_dump_json()
    assert np.array_equal(of_two, values, equal_nan=True)


def test_sums_of_partitions_of_any_size_agree(units: list[partitions.UnitOfLot]) -> None:
    knots = units[0][0].knots
    lot = np.array([int(name[-1]) for _, name in units])
    lot -= lot.min()
    w = np.random.default_rng(2).choice([1.0, 0.3], 60)
    law = VarianceComponents(*(SIZE**2 * scale * np.eye(knots.q) for scale in (1.0, 0.1)))
    J, h = mixed_model._stacked(knots, units)
    found = []
    for size in (1, 7, 60):
        cuts = [slice(k, k + size) for k in range(0, 60, size)]
        under = UnitsUnderLaw(law, [(J[cut, 1], h[cut, 1], lot[cut]) for cut in cuts])
        found.append((e_step(under, w), under.means(w)))
    for other, means in found[1:]:
        for name in ("share", "spread", "scatter", "between"):
            one = getattr(found[0][0], name)
            assert_allclose(getattr(other, name), one, rtol=1e-9, atol=1e-9 * np.max(np.abs(one)))
        assert_allclose(means.mu, found[0][1].mu, rtol=1e-9)


def test_families_of_partitions_of_any_size_are_the_same(units: list[partitions.UnitOfLot]) -> None:
    """Their sums are of SIZE units each, however many lie together: near its tolerance EM is led by additions."""
    one, other = (fit_family(in_partitions(units, size)) for size in (7, 60))
    assert other.model_dump_json() == one.model_dump_json()
