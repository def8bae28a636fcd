"""A lot that is off is the lot's, a change that stays is the line's, and neither is said twice."""

import numpy as np
import pytest
from lines import line

from driftlab.family.outliers import LotOutlier
from driftlab.spc.line import line_of, reconcile


def said(records, *lots):
    """Return the lots that are told, and what the line says."""
    odd = [LotOutlier(lot, "noise", "y", f"lot {lot} is off") for lot in lots]
    kept, found = reconcile(odd, line_of(records, None))
    return [lot.lot for lot in kept], " ".join(found.sentences)


def test_a_lot_that_comes_and_goes_is_told_as_a_lot():
    records = line(200, 1, planted=[("noise", "y", 80, 100, 3.0)])  # the units of L04
    assert "y noise rose" in " ".join(line_of(records, None).sentences)
    lots, text = said(records, "L04")
    assert lots == ["L04"]
    assert "y noise rose" not in text
    assert "Off as a whole: lot L04. Beside that no change of the line in 200 units" in text


def test_a_change_that_stays_is_told_as_the_lines():
    records = line(200, 1, planted=[("noise", "y", 140, 200, 3.0)])  # L07, L08 and L09
    lots, text = said(records, "L07", "L08", "L09")
    assert lots == []
    assert "y noise rose" in text


def test_a_lot_inside_a_stretch_that_is_off_by_itself_is_told_beside_the_change():
    records = line(200, 1, planted=[("noise", "y", 140, 200, 3.0), ("noise", "y", 40, 60, 3.0)])
    lots, text = said(records, "L02", "L07", "L08", "L09")
    assert lots == ["L02"]
    assert "y noise rose by" in text
    assert text.count("y noise rose") == 1


@pytest.mark.parametrize("quantity", ["residual", "walk"])
def test_deviations_that_go_with_the_values_make_no_alarms(quantity):
    beyond = values = 0
    for seed in range(5):
        records = line(100, seed)
        rng = np.random.default_rng(seed)
        for k, record in enumerate(records):
            figure = record.figures[quantity]
            of = np.array(figure.value)
            own = of * (of / np.median(of)) * rng.uniform(0.02, 0.6, size=3)  # an estimate, from the same soak
            new = figure.model_copy(update={"sigma": tuple(own.tolist())})
            records[k] = record.model_copy(update={"figures": {**record.figures, quantity: new}})
        charts = [chart for chart in line_of(records, None).controls if chart.quantity == quantity]
        beyond += sum(int(np.sum(chart.beyond)) for chart in charts)
        values += sum(len(chart.at) for chart in charts)
    assert beyond <= 4 * values / 370
