"""Parameter files: every way in which ground stations write them reads the same."""

import numpy as np
import pytest

from fusion_core.errors import UnreadableFile
from fusion_plugins.exporters.autopilot import read_parameters, single

WRITTEN = {
    "QGroundControl": "# Vehicle-Id ...\n1\t1\tTC_G_ENABLE\t1\t6\n1\t1\tTC_G0_X3_0\t-2.5e-09\t9\n",
    "MAVProxy": "TC_G_ENABLE      1.000000\nTC_G0_X3_0       -2.5e-09\n",
    "Mission Planner": "#NOTE: saved\r\nTC_G_ENABLE,1\r\nTC_G0_X3_0,-2.5E-09\r\n",
    "Notepad": "\ufeffTC_G_ENABLE,1\r\nTC_G0_X3_0,-2.5E-09\r\n",
    "in the bootloader": "TC_G_ENABLE=1\nTC_G0_X3_0=-2.5e-9\n",
    "by hand": "\n  TC_G_ENABLE\t1   # on\n\nTC_G0_X3_0 = -2.5e-9\n",
}


@pytest.mark.parametrize("by", WRITTEN)
def test_all_ways_of_writing_read_the_same(by, tmp_path):
    (tmp_path / "a").write_bytes(WRITTEN[by].encode())
    assert read_parameters(tmp_path / "a") == {"TC_G_ENABLE": 1.0, "TC_G0_X3_0": -2.5e-9}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"TC_G_ENABLE one\n", "line 1: 'TC_G_ENABLE one' is no parameter"),
        (b"A 1\nB nan\n", "line 2: 'B nan' is no parameter"),
        (b"A 1 2\n", "line 1: 'A 1 2' is no parameter"),
        (b"A 1\nB 2\nA 3\n", "line 3: A is 3, and 1 further up; keep one"),
        (b"\xff\xfe\x00A", "is no text, expected a parameter file"),
    ],
)
def test_what_is_no_parameter_file_is_refused_by_its_line(content, says, tmp_path):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(UnreadableFile, match=says):
        read_parameters(tmp_path / "a")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UnreadableFile, match=r"cannot be read \(No such file or directory\); name a parameter file"):
        read_parameters(tmp_path / "a")


def test_texts_of_single_precision_are_the_shortest_that_hit_it():
    rng = np.random.default_rng(0)
    values = (rng.normal(size=20_000) * 10.0 ** rng.integers(-12, 6, 20_000)).astype(np.float32)
    texts = [single(value) for value in values]
    assert np.array_equal(np.array(texts, dtype=np.float32), values)
    assert max(map(len, texts)) <= 15
    assert single(0.1) == "0.1"
