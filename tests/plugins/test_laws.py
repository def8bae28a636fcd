"""Every built-in plugin under the laws of its family, as a third party would hold its own to them."""

import gzip
import struct
import zlib

import numpy as np
import pytest
from bags import FIELDS, unit
from bags import write as write_bag
from logger_files import xlsx
from recordings_on_disk import KINDS, channels, columns, write
from ulog_writer import sensor, write_ulog

from fusion_core.contracts import BiasModel, Effect, Exporter, Framing, MeasurementModel, Source, Stimulus, ThermalMap
from fusion_core.host.registry import registry
from fusion_core.testing import check_plugin, laws
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.effects.thermal_lag import ThermalLag
from fusion_plugins.framings.binary import Binary
from fusion_plugins.framings.kvh_1775 import Kvh1775
from fusion_plugins.framings.text import Text
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.rosbag import Rosbag
from fusion_plugins.sources.synthetic import Synthetic
from fusion_plugins.sources.ulog import Ulog
from fusion_plugins.sources.xlsx import Xlsx
from fusion_plugins.thermal_maps.polynomial import Polynomial


def kinds(family):
    return sorted(registry().classes(family).items())


FAMILIES = (BiasModel, ThermalMap, Source, Framing, Effect, MeasurementModel, Exporter, Stimulus)
OWN = {  # held to their laws below; a kind may be that of two families
    (BiasModel, "thermal_derivative"),
    *((Source, kind) for kind in ("binary_log", "csv", "dataflash", "hdf5", "mat", "parquet", "rosbag", "serial",
                                  "synthetic", "ulog", "xlsx")),
    *((Framing, kind) for kind in ("text", "binary", "kvh_1775")),
}  # fmt: skip
PLAIN = {(family, kind): laws(cls) for family in FAMILIES for kind, cls in kinds(family) if (family, kind) not in OWN}


def test_no_plugin_is_left_out():
    held = OWN | {pair for pair, found in PLAIN.items() if found}
    installed = {(family, kind) for family in FAMILIES for kind, _ in kinds(family)}
    assert installed == held, f"{installed ^ held}; give it `examples`, or its laws below and its name in OWN"


@pytest.mark.parametrize("law", [law for found in PLAIN.values() for law in found], ids=str)
def test_plugins_with_examples_of_their_own(law):
    law()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.json"
    T = np.linspace(0, 50, 200)
    Polynomial(order=2).fit(T, np.stack([T, T**2, -T], axis=1) * 1e-6, {}).save(path)
    return Polynomial(order=2, path=path)


def test_bias_models_with_maps_and_effects(fitted):
    effects = (
        Hysteresis(width=2.0, coefficients=(1e-5, 2e-5, 3e-5)),
        Relaxation(coefficients=(0.0,) * 3, sigma=(1e-5,) * 3, estimate=True, initial=(1e-6,) * 3),
        ThermalLag(tau=30.0),
    )
    examples = [
        ThermalDerivative(walk=1e-6),
        ThermalDerivative(walk=1e-6, map=fitted),
        ThermalDerivative(walk=1e-6, map=fitted, form="slope"),
        ThermalDerivative(walk=1e-6, map=fitted, effects=effects, repeatability=1e-4),
    ]
    check_plugin(ThermalDerivative, examples)


def test_file_sources(tmp_path):
    examples = []
    for kind in KINDS:
        path = write(kind, tmp_path / kind.model_fields["kind"].default, columns(400))
        examples.append(kind(path=path, channels=channels()))
    path = write_bag(tmp_path / "bag", "mcap", lambda types: unit(types, 400))
    examples.append(Rosbag(path=path, channels=FIELDS))
    packed = tmp_path / "r.csv.gz"
    packed.write_bytes(gzip.compress((tmp_path / "csv").read_bytes()))
    examples.append(Csv(path=packed, channels=channels()))
    book = tmp_path / "r.xlsx"
    table = columns(400)
    book.write_bytes(xlsx({"Data": [list(table), *np.column_stack(list(table.values())).tolist()]}))
    examples.append(Xlsx(path=book, channels=channels()))
    for source in examples:
        check_plugin(type(source), [source])


def test_a_log_of_an_autopilot(tmp_path):
    t = np.arange(400) / 10
    T = 20 + t / 10
    rows = [sensor(f"sensor_{name}", 0, t, np.sin(t)[:, None] * np.ones(3), T, 0x26000A) for name in ("gyro", "accel")]
    path = write_ulog(tmp_path / "v.ulg", rows)
    axes = {name: {"path": [f"sensor_{name}.{a}" for a in "xyz"]} for name in ("gyro", "accel")}
    one = {"time": {"path": "sensor_gyro.time"}, "temperature": {"path": "sensor_gyro.temperature"}}
    check_plugin(Ulog, [Ulog(path=path, channels=axes | one)])


def test_a_simulated_unit():
    check_plugin(Synthetic, [Synthetic(duration=5.0, rate=100.0, latitude=0.7)])


def lines(N=40):
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(N, 3)).round(6).tolist()
    return "".join(f"{k},{x!r},{y!r},{z!r}\n" for k, (x, y, z) in enumerate(rows)).encode()


def test_framing_of_text():
    column = {"path": ["x", "y", "z"], "unit": "deg/s"}
    settings = {"channels": {"gyro": column}, "columns": ["n", "x", "y", "z"], "counter": {"field": "n", "modulo": 256}}
    check_plugin(Text, [Text.model_validate(settings)], stream=lines())
    settings["columns"] = None
    check_plugin(Text, [Text.model_validate(settings)], stream=b"n,x,y,z\n" + lines())


def test_framings_of_bytes():
    rng = np.random.default_rng(3)
    numbers = rng.integers(-(2**15), 2**15, size=(40, 3))
    bodies = [b"\xaa\x55" + struct.pack("<3h", *row) for row in numbers]
    stream = b"".join(body + struct.pack("<I", zlib.crc32(body)) for body in bodies)
    fields = [{"name": "gyro", "type": "int16", "count": 3, "unit": "0.01 deg/s"}]
    settings = {"sync": "AA 55", "fields": fields, "checksum": {"kind": "CRC-32/ISO-HDLC"}}
    check_plugin(Binary, [Binary.model_validate(settings)], stream=stream)


def test_the_kvh_1775():
    for message, more in (("A", b""), ("B", struct.pack(">I", 12345))):
        body = bytes.fromhex("FE81FF55" if message == "A" else "FE81FF56") + struct.pack(">6f", *range(6)) + more
        frames = []
        for k in range(30):
            whole = body + struct.pack(">BBh", 0x77, k, 25)
            crc = fastcrc_of(whole)
            frames.append(whole + struct.pack(">I", crc))
        example = Kvh1775(message=message, interval=0.01)
        check_plugin(Kvh1775, [example], stream=b"".join(frames))


def fastcrc_of(data):
    from fastcrc import crc32

    return crc32.mpeg_2(data)
