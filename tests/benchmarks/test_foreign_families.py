"""Lines of units that share no code with the project: spreads, and what is odd in the odd ones."""

import numpy as np
import pytest
from foreign_families import GRID, LAWS, LEVEL, ODD, SHAPE, WHITE, draw


@pytest.mark.parametrize("law", LAWS)
def test_a_line_spreads_as_its_law_says(law):
    line = draw(1, law, 300, hours=0.1)
    assert len(line.units) == 300
    assert len(line.soaks) > 300
    curves = np.array([u.curve for u in line.units])
    levels = curves.mean(axis=1)
    shapes = curves - levels[:, None]
    drawn, said = np.sqrt(shapes.var(axis=0).mean(axis=0)), np.sqrt((line.spread**2).mean(axis=0))
    if law == "t3":  # 300 units of it say little of its second moment, but half of them are within 0.44 of it
        half = np.diff(np.quantile(levels, [0.25, 0.75], axis=0), axis=0)[0] / 2
        assert half == pytest.approx(0.4416 * LEVEL, rel=0.15)
    else:
        assert levels.std(axis=0) == pytest.approx(line.level_spread, rel=0.25)
        assert drawn == pytest.approx(said, rel=0.25)
    assert line.level_spread == pytest.approx(LEVEL, rel=0.25)
    assert np.sqrt((line.spread**2).mean()) == pytest.approx(SHAPE)


def test_what_is_odd_is_as_odd_as_it_was_asked_to_be():
    for seed, law in enumerate(LAWS):
        clean, line = draw(seed, law, 20, hours=0.5), draw(seed, law, 20, ODD, 6.0, hours=0.5)
        assert sorted(line.odd.values()) == sorted(ODD)
        for good, unit in zip(clean.units, line.units, strict=True):
            change, k = unit.curve - good.curve, unit.axis
            rms = np.sqrt((change**2).mean(axis=0))
            if not unit.odd:
                assert not change.any()
            elif unit.odd == "offset":
                assert rms[k] == pytest.approx(6 * line.level_spread[k])
            elif unit.odd == "scale":
                assert rms[k] == pytest.approx(6 * np.sqrt((line.spread[:, k] ** 2).mean()))
            elif unit.odd == "bump":
                at = np.argmax(np.abs(change[:, k]))
                assert abs(change[at, k]) == pytest.approx(6 * line.spread[at, k], rel=0.05)
            elif unit.odd == "swapped":
                assert (unit.curve == good.curve[:, [1, 0, 2]]).all()
                assert 3 < unit.times < 20
            elif unit.odd == "sign":
                assert (unit.curve[:, k] == -good.curve[:, k]).all()
                assert unit.times > 3
            elif unit.odd in ("walk", "noise"):
                assert unit.times == 3
                factors = (unit.walk / good.walk, unit.white / good.white)[unit.odd == "noise"]
                assert factors[k] == pytest.approx(3)
            elif unit.odd == "hysteresis":
                size = 6 * np.sqrt((line.spread[:, k] ** 2).mean())
                assert abs(unit.slope) * 2 * unit.width == pytest.approx(size)
            else:
                assert unit.odd == "two_units"
                assert sum(s.unit == unit.name for s in line.soaks) == 2


def test_a_soak_is_its_unit_and_its_noise():
    line, again = (draw(4, "normal", 12, hours=2.0) for _ in range(2))
    assert (line.soaks[3].bias == again.soaks[3].bias).all()
    by_name = {u.name: u for u in line.units}
    for soak in line.soaks:
        assert soak.bias.shape == (720, 3)
        unit = by_name[soak.unit]
        curve = np.column_stack([np.interp(soak.T, GRID, unit.curve[:, k]) for k in range(3)])
        left = np.diff(soak.bias - curve, axis=0).std(axis=0) / np.sqrt(2) * np.sqrt(10)
        assert left / unit.white == pytest.approx(1.0, abs=0.12)
    assert np.median([u.white for u in line.units]) == pytest.approx(WHITE, rel=0.1)
    with pytest.raises(ValueError, match="law"):
        draw(1, "weibull")
