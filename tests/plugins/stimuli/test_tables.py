import numpy as np
import pytest

from fusion_core.errors import ConfigError, DataError
from fusion_plugins.stimuli.tables import direction, segments


@pytest.mark.parametrize(
    ("text", "vector"), [("x", (1, 0, 0)), (" -Y", (0, -1, 0)), ("0.6 0 0.8", (0.6, 0, 0.8)), ("0; 0; -2", (0, 0, -1))]
)
def test_an_axis_is_a_unit_vector(text, vector):
    np.testing.assert_allclose(direction(text), vector)


@pytest.mark.parametrize("text", ["", "w", "0 0 0", "1 2", "x y z", "nan 0 1"])
def test_what_is_no_axis_is_refused(text):
    with pytest.raises(ConfigError, match="is no direction; write x, y, z, -x"):
        direction(text)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("", "its head is ''; write `start "),
        ("start [s],stop [s],axis\n", r"its head is 'start \[s\],stop \[s\],axis'; write"),
        ("start [s],stop [s],axis,rate [deg/s]\n", "has no line under its head"),
        ("start [s],stop [s],axis,rate\n0,1,x,3\n", "line 2: column rate has no unit in the head"),
        ("start [s],stop [s],axis,rate [deg]\n0,1,x,3\n", "line 2: .*deg"),
        ("start [s],stop [s],axis,rate [deg/s]\n0,1,x,3\n0,1,q,3\n", "line 3: axis 'q': is no direction"),
        ("start [s],stop [s],axis,rate [deg/s]\n0,1,x,inf\n", "line 2: rate is inf, a finite number was expected"),
        ("start [s],stop [s],axis,rate [deg/s]\n0,one,x,3\n", "line 2: .*'one'"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_by_its_line(tmp_path, table, message):
    (tmp_path / "table.csv").write_text(table)
    with pytest.raises(DataError, match=message):
        segments(tmp_path / "table.csv", rates=True)
