"""An ArduPilot log as text reads as the binary one that it was made from."""

import gzip

import numpy as np
import pytest
from dataflash_writer import BARO, FMT, MESSAGES, Format, formats, imu_rows, parameters, rows
from pymavlink import DFReader
from recordings_on_disk import read

from fusion_core.errors import MissingChannel
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash import DataFlash

CHANNELS = {
    "time": {"path": "IMU.TimeUS"}, "gyro": {"path": ["IMU.GyrX", "IMU.GyrY", "IMU.GyrZ"]},
    "accel": {"path": ["IMU.AccX", "IMU.AccY", "IMU.AccZ"]}, "temperature": {"path": "IMU.T"},
    "pressure": {"path": "BARO.Press"}, "heat": {"path": "BARO.Temp"},
}  # fmt: skip
MODE = Format(150, "MODE", "QMB", "TimeUS,Mode,Rsn", "s--", "F--")


@pytest.fixture
def binary(tmp_path):
    rng = np.random.default_rng(4)
    t = 20 + np.arange(300) / 10
    units = [(0.01 * rng.normal(size=(300, 3)), rng.normal(size=(300, 3)), 20 + t / 10) for _ in range(2)]
    path = tmp_path / "l.bin"
    baro = rows(BARO, {"TimeUS": np.rint(t * 1e6), "Press": 101325 + t, "Temp": np.round(100 * (25 + t / 7))}, 300)
    values = {"AHRS_ORIENTATION": 4, "INS_GYROFFS_X": 0.015625, "INS_TCAL1_ENABLE": 0}
    mode = rows(MODE, {"TimeUS": 30e6, "Mode": 5, "Rsn": 1}, 1)
    body = imu_rows(t, units).tobytes() + baro.tobytes() + mode.tobytes()
    path.write_bytes(formats([*MESSAGES, MODE]) + parameters(values) + body)
    return path


def as_text(path, to):
    """Write the log as ground stations do: by pymavlink's reader, numbers as they are shown."""
    log, lines = DFReader.DFReader_binary(str(path)), []
    while (message := log.recv_msg()) is not None:
        name, fields = message.get_type(), message.to_dict()
        if name == "FMT":
            values = [fields[key] for key in ("Type", "Length", "Name", "Format", "Columns")]
        else:
            kind = message.fmt
            values = [getattr(message, column) for column in kind.columns]
            unscaled = {"PARM": {}, "FMTU": {}}.get(name, dict(zip(kind.columns, kind.msg_mults, strict=True)))
            # pymavlink applies what FMTU multiplies by too; the text of ground stations has the letter's factor alone
            for k, column in enumerate(kind.columns):
                letter = kind.format[k]
                if isinstance(values[k], float | int) and letter not in "cCeEL" and unscaled.get(column):
                    values[k] = values[k] / unscaled[column]
                if letter in "bBhHiIqQM":
                    values[k] = round(values[k])
        if name == "MODE":
            values[1] = "LOITER"
        lines.append(", ".join([name, *(repr(v) if isinstance(v, float) else str(v) for v in values)]))
    log.filehandle.close()
    to.write_text("\n".join(lines) + "\n")
    return to


def used(path):
    chunk = read(DataFlash(path=path, channels=CHANNELS))
    return chunk.t, chunk


def test_text_reads_as_the_binary_log(binary, tmp_path):
    text = as_text(binary, tmp_path / "l.log")
    packed = tmp_path / "l.log.gz"
    packed.write_bytes(gzip.compress(text.read_bytes()))
    t, expected = used(binary)
    for path in (text, packed):
        got, found = used(path)
        np.testing.assert_array_equal(got, t)
        for name in ("gyro", "accel", "temperature", "pressure", "heat"):
            np.testing.assert_array_equal(found[name], expected[name])
    assert dict(DataFlash.parameters(packed)) == DataFlash.parameters(binary) != {}
    assert DataFlash.signatures[1] == text.read_bytes()[:5]


def test_lines_that_are_none_are_counted_and_the_rest_is_read(binary, tmp_path):
    text = as_text(binary, tmp_path / "l.log")
    lines = text.read_text().splitlines()
    rows_of_imu = [k for k, line in enumerate(lines) if line.startswith("IMU, ")]
    lines[rows_of_imu[10]] = lines[rows_of_imu[10]][:25]  # cut
    lines[rows_of_imu[20]] = lines[rows_of_imu[20]].replace(".", ",")  # decimal commas
    lines[rows_of_imu[30]] = lines[rows_of_imu[30]].replace("IMU, ", "IMU, x")  # no number
    lines.insert(rows_of_imu[40], "hello")
    text.write_text("\n".join(lines))
    faults = Faults()
    with DataFlash(path=text, channels=CHANNELS).open(text, faults):
        pass
    assert any("lines of the log that are no rows, skipped: 4" in line for line in faults.lines())
    assert len(used(text)[0]) == len(used(binary)[0]) - 3


def test_a_text_without_rows_says_so(tmp_path):
    path = tmp_path / "1.log"
    path.write_text(f"FMT, {FMT.type}, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n")
    with pytest.raises(MissingChannel, match="has no message 'IMU'"):
        used(path)
