import numpy as np
from effect_recordings import on_one_axis

from fusion_core.chunk import Chunk
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.common import auxiliary


def test_channel_gives_the_channel_column_by_column():
    rng = np.random.default_rng(4)
    field, V = rng.normal(size=(20, 2)), rng.normal(size=20)
    chunk = Chunk(
        np.arange(20.0),
        {"field": field, "voltage": V, "temperature": V, "temperature_case": V, "gyro": V},
        sensors=frozenset({"gyro"}),
    )
    np.testing.assert_array_equal(on_one_axis(Channel(), chunk)[:, 0], V)
    assert auxiliary([chunk]) == ["field", "voltage"]
    by_name = {c.channel: c for c in Channel().proposals([chunk])}
    assert set(by_name) == {"field", "voltage"}
    np.testing.assert_array_equal(on_one_axis(by_name["field"], chunk), field)
    assert by_name["field"].labels[:2] == ("x_field_0", "x_field_1")
