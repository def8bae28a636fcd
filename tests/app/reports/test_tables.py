"""The tables of errors: what decides comes first, every number is whole, a name is folded where its words end."""

import io
import re

import numpy as np
import pytest
from rich.console import Console

from driftlab.evaluation.scores import HORIZONS, Scores
from driftlab.reports.tables import error_table, folded, yardstick_table
from driftlab.units import RATE, BiasUnit
from fusion_plugins.measurement_models.zupt import Zupt

DEG_H = np.deg2rad(1.0) / 3600
GYRO = Zupt.examples()[0].tracked


def yardsticks(error):
    values = np.array([1.0, 2.0, 3.0]) * error * DEG_H
    each = dict.fromkeys(HORIZONS, values)
    return Scores(
        ("x", "y", "z"), values, values, each, each, dict.fromkeys(HORIZONS, 0.01), dict.fromkeys(HORIZONS, 1.0), 0.0
    )


def printed(table, width=80):
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    return console.file.getvalue()


COASTS = [part for name in ("to the end", "10 min", "5 min", "1 min") for part in (f"prediction, {name}", "its sigma")]


def test_the_longest_coast_is_first_and_the_filter_s_own_error_after_the_coasts():
    rows = re.findall(r"^│ +([a-z][^│]*?) +│", printed(yardstick_table({"a": yardsticks(1)}, "t", GYRO)), re.MULTILINE)
    headings = [f"heading, {name}" for name in ("to the end", "10 min", "5 min", "1 min")]
    assert rows == [*COASTS, "bias, all", "bias, first 30 s", *headings]


def test_of_several_runs_the_rms_over_the_axes_comes_first():
    text = printed(yardstick_table({"a": yardsticks(1), "b": yardsticks(10)}, "t", GYRO))
    rows = re.findall(r"^│ +([a-z][^│]*?) +│", text, re.MULTILINE)
    assert rows[:16] == COASTS * 2
    first = next(line for line in text.splitlines() if "prediction, to the end" in line)
    # sqrt((1 + 4 + 9) / 3)
    assert re.findall(r"\S+", first.replace("│", " "))[-3:] == ["rms", "2.16", "21.60"]


NAMES = ["standard_of_twenty_c", "tczupt_of_twenty_cha", "nogapsinthisnametwen", "another.20-characters"]


@pytest.mark.parametrize("count", [3, 4])
def test_80_columns_hold_configs_with_long_names_and_large_errors(count):
    runs = {name: yardsticks(1234.56) for name in NAMES[:count]}
    text = printed(yardstick_table(runs, "t", GYRO))
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    for axis, value in (("x", "1234.56"), ("y", "2469.12"), ("z", "3703.68")):
        lines = [line for line in text.splitlines() if re.search(rf"│ +{axis} +│", line)]
        assert lines
        assert all(line.count(value) == count for line in lines)
    assert text.count("[deg/h]") == count  # one unit, said of each


def test_a_name_is_folded_after_what_separates_its_words():
    assert folded("standard_of_twenty_c", 12) == ["standard_of_", "twenty_c"]
    assert folded("a-b.yaml", 12) == ["a-b.yaml"]
    assert folded("nogapsinthisname", 12) == ["nogapsinthis", "name"]
    for width in (8, 9, 12):
        for name in NAMES:
            assert "".join(folded(name, width)) == name
            assert max(map(len, folded(name, width))) <= width


def test_the_paper_s_unit_is_si_and_a_ratio_stays_in_its_own():
    rows = [("mean", [np.array([1e-5])])]
    assert "1.000e-05" in printed(error_table("t", ["a"], RATE, (["x"], rows), si=True))
    ppm = BiasUnit("1", "ppm")
    assert printed(error_table("t", ["a"], ppm, (["x"], rows), si=True)) == printed(
        error_table("t", ["a"], ppm, (["x"], rows))
    )
