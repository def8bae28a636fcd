import pytest
from turned_units import tumble

from fusion_core.errors import NotAtRest
from fusion_plugins.stimuli.placements import rests


def test_rests_are_found_where_the_unit_was_left_alone():
    time, y, _ = tumble(0, [20.0], placements=10, hold=5.0)
    found = rests(time, y, least=2.0)
    assert len(found) == 10
    for k, (a, b) in enumerate(found):
        assert 6 * k + 1 <= time[a] < time[b - 1] <= 6 * k + 6
    with pytest.raises(NotAtRest, match=r"0 placements at rest for 30 s .* set stimulus.rest lower"):
        rests(time, y, least=30.0)
