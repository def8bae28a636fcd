"""Several processes that go through the units of a fleet, and the files in which they find them without effects."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import unit_work
from families_at_rest import effect_of

from driftlab.family.basis import STEP
from driftlab.family.partitions import ScratchFolder
from driftlab.family.shared_effect import SharedEffect, without_effects
from driftlab.family.unit_information import UnitInformation
from driftlab.production.family import _apart
from driftlab.production.fleet_folder import stored_units
from driftlab.production.unit_folders import UNITS, UnitPlace
from driftlab.production.workers import Pool
from driftlab.soak.blocks import SoakRows
from fusion_core.errors import DataError, UnreadableFile

COUNT = 12


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Return units that warm and cool, with a hysteresis of 2 a K."""
    folder, rng = tmp_path_factory.mktemp("fleet"), np.random.default_rng(4)
    t = np.arange(240) * 10.0
    T = 20.0 + 20.0 * np.sin(2 * np.pi * t / 2400)
    for k in range(COUNT):
        bias = rng.normal() + 0.1 * T + 2.0 * (np.cos(2 * np.pi * t / 2400) < 0) + 0.1 * rng.normal(size=240)
        rows = SoakRows(t, T, np.stack([bias, bias, -bias], axis=1), np.full(240, 10.0), {})
        soaked = UnitInformation.of(f"{k:02d}", ("x", "y", "z"), [rows], np.full(3, 0.3), np.full(3, 1e-3), STEP)
        (folder / UNITS / soaked.unit).mkdir(parents=True)
        (folder / UNITS / soaked.unit / "unit.npz").write_bytes(soaked.to_bytes())
    return stored_units(UnitPlace(folder, b""), [f"{k:02d}" for k in range(COUNT)], [f"L{k % 2}" for k in range(COUNT)])


@pytest.fixture(scope="module")
def hands():
    with Pool(2) as pool:
        yield pool.ordered


def test_what_comes_back_is_in_order_and_the_same_as_of_one_process(hands, kept):
    times = [0.05, 0.0, 0.0, 0.02, 0.0, 0.01, 0.0]  # the first is done last
    found = list(hands(unit_work.burn, times))
    assert len(found) == len(times)
    assert len(set(found)) == 2
    assert list(hands(partial(pow, 2), range(25))) == [2**k for k in range(25)]
    assert [len(part) for part in kept.parts] == [8, 4]
    assert list(hands(unit_work.information, kept.parts)) == list(map(unit_work.information, kept.parts))


def test_what_an_item_raises_is_raised_here(hands):
    with pytest.raises(ValueError, match=r"invalid literal .*none"):
        list(hands(int, ["1", "2", "none"]))
    assert list(hands(int, ["1"])) == [1]


def test_who_dies_is_said(hands):
    with pytest.raises(DataError, match=r"in common: its worker was killed .*; give the same command again"):
        list(hands(unit_work.misbehave, ["killed"]))
    assert list(hands(int, ["1"])) == [1]


def test_what_a_process_was_killed_with_is_done_once_more(hands, tmp_path):
    paths = [str(tmp_path / name) for name in "abc"]
    for path in paths[1:]:
        (tmp_path / path).touch()  # these have been met already
    assert list(hands(unit_work.once_then_killed, paths)) == ["came back"] * 3


def test_units_that_are_kept_are_those_without_the_effects_and_come_again(kept, hands, tmp_path):
    effect = effect_of("hysteresis", width=1.0)
    shared = SharedEffect(
        mean=np.full((3, 1), 2.0), sigma=np.full((3, 1), 0.01), spread=np.full((3, 1), 0.1), effect=effect,
        unit="rad/s/K", evidence=9, of_mean=9, of_size=9, price=5, left_out=1.0,
        in_other_lots=None, indistinguishable_from=(),
    )  # fmt: skip
    expected = [(without_effects(soaked, lot, [shared]), lot) for soaked, lot in kept.read()]
    for engine, scratch in ((map, None), (hands, ScratchFolder(tmp_path))):
        units = replace(kept, engine=engine, scratch=scratch)
        units = units.keep("apart", partial(_apart, [shared]), [None] * COUNT, [k == 5 for k in range(COUNT)])
        assert len(units) == COUNT
        for _ in range(2):
            found = list(units.read())
            for (one, its), (other, lot) in zip(found, expected, strict=True):
                assert (one.unit, its, len(one.recordings)) == (other.unit, lot, one.unit == "05")
                assert np.array_equal(one.J, other.J)
                assert np.array_equal(one.h, other.h)
        some = units.chosen([2, 5, 11], 2)
        assert [[soaked.unit for soaked, _ in part.read()] for part in some.parts] == [["02", "05"], ["11"]]


def test_a_file_that_is_damaged_is_named_wherever_it_is_read(kept, hands):
    path = kept.parts[0].folders.unit("07") / "unit.npz"
    content = path.read_bytes()
    path.write_bytes(content[:1000])
    try:
        for engine in (map, hands):
            with pytest.raises(UnreadableFile, match=r"07/unit\.npz: is missing or damaged; remove the folder"):
                list(replace(kept, engine=engine).map(unit_work.count))
    finally:
        path.write_bytes(content)
