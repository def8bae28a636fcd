"""Frames and what is none, wherever the stream is cut. Frames are packed here, with struct and zlib."""

import functools
import operator
import struct
import types
import zlib
from typing import Literal

import numpy as np
import pytest
from bench import FRAMING, SIZE, SYNC, frame
from device_frames import kvh
from doses import draws
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fusion_core.chunk import Chunk
from fusion_core.contracts.framing import DAMAGED, GARBAGE, Frames, Framing
from fusion_core.errors import ConfigError, MissingChannel
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Registry, registry


def framing(**config):
    return registry().classes(Framing)[config["kind"]].model_validate(config)


def decoded(decoder, pieces):
    """Return the channels, the counter and what was rejected, over all pieces."""
    memory, parts, rejected = None, [], {}
    for piece in pieces:
        frames, memory = decoder.decode(piece, memory)
        parts.append(frames)
        for what, count in frames.rejected.items():
            rejected[what] = rejected.get(what, 0) + count
    channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
    count = np.concatenate([part.count for part in parts]) if parts[0].count is not None else None
    return channels, count, rejected


def cut(stream, cuts):
    places = sorted({min(c, len(stream)) for c in cuts})
    return [stream[a:b] for a, b in zip([0, *places], [*places, len(stream)], strict=True)]


def intact(stream):
    """The counters of the frames in a stream, walked byte by byte."""
    found, at = [], 0
    while at + SIZE <= len(stream):
        one = stream[at : at + SIZE]
        good = one.startswith(SYNC) and struct.pack("<I", zlib.crc32(one[:-4])) == one[-4:]
        found += [struct.unpack_from("<H", one, 2)[0]] if good else []
        at += SIZE if good else 1
    return found


BINARY = framing(**FRAMING)
INTACT = st.integers(0, 65535).map(lambda k: (k, frame(k, gyro=(k * 1e-6, 0, -k * 1e-7))))
WITH_SYNC_INSIDE = st.integers(0, 65535).map(lambda k: (k, frame(k, gyro=np.frombuffer(SYNC * 12, "<f8"))))
GARBLED = st.binary(max_size=80)
TORN = st.tuples(st.integers(0, 65535), st.integers(1, SIZE - 1)).map(lambda a: frame(a[0])[: a[1]])
HEADLESS = st.tuples(st.integers(0, 65535), st.integers(1, SIZE - 1)).map(lambda a: frame(a[0])[a[1] :])
FLIPPED = st.tuples(st.integers(0, 65535), st.integers(0, 8 * SIZE - 1)).map(
    lambda a: bytes(b ^ (1 << a[1] % 8 if i == a[1] // 8 else 0) for i, b in enumerate(frame(a[0])))
)
FALSE_SYNC = st.binary(max_size=20).map(lambda tail: SYNC + tail)


@settings(max_examples=draws(60, 300))
@given(
    st.lists(st.one_of(INTACT, INTACT, WITH_SYNC_INSIDE, GARBLED, TORN, HEADLESS, FLIPPED, FALSE_SYNC), max_size=25),
    st.lists(st.integers(0, 2500), max_size=30),
)
def test_the_intact_frames_come_out_and_nothing_else(pieces, cuts):
    """Any stream, split anywhere: the frames that were sent whole, in order, and every other byte is accounted for."""
    stream = b"".join(piece[1] if isinstance(piece, tuple) else piece for piece in pieces) + bytes(SIZE)
    sent = intact(stream)
    whole_ones = iter(sent)
    assert all(piece[0] in whole_ones for piece in pieces if isinstance(piece, tuple))  # in this order
    channels, count, rejected = decoded(BINARY, cut(stream, cuts))
    np.testing.assert_array_equal(count, sent)
    assert all(len(values) == len(sent) for values in channels.values())
    left_over = len(stream) - len(sent) * SIZE
    assert left_over - SIZE < rejected.get(GARBAGE, 0) <= left_over
    whole = decoded(BINARY, [stream])
    assert whole[2] == rejected
    for name, values in whole[0].items():
        np.testing.assert_array_equal(channels[name], values)


@settings(max_examples=draws(60, 200))
@given(st.binary(max_size=60).map(lambda b: b.replace(b"\x00", b"\xa5")), st.lists(st.integers(0, 400), max_size=8))
def test_weak_checksums_are_scanned_as_defined(noise, cuts):
    """An eight-bit sum lets some noise through; which, is said by the definition, walked here byte by byte."""
    decoder = framing(
        kind="binary", sync="A5", fields=[{"name": "v", "type": "uint8"}], checksum={"kind": "sum8", "start": 1}
    )
    stream = noise + bytes([0xA5, 7, 7]) + noise
    expected, at = [], 0
    while at + 3 <= len(stream):
        if stream[at] == 0xA5 and stream[at + 1] == stream[at + 2]:
            expected.append(stream[at + 1])
            at += 3
        else:
            at += 1
    channels, _, _ = decoded(decoder, cut(stream, cuts))
    np.testing.assert_array_equal(channels["v"], expected)


@pytest.mark.parametrize("lost", range(1, SIZE))
def test_a_frame_torn_at_any_byte_costs_that_frame_alone(lost):
    stream = frame(1) + frame(2)[:lost] + frame(3) + frame(4)
    _, count, rejected = decoded(BINARY, [stream, b"", bytes(SIZE)])
    np.testing.assert_array_equal(count, [1, 3, 4])
    assert rejected[GARBAGE] >= lost


@pytest.mark.parametrize("bit", range(0, 8 * SIZE, 5))
def test_a_flipped_bit_is_caught_by_the_checksum(bit):
    bad = bytearray(frame(2))
    bad[bit // 8] ^= 1 << bit % 8
    _, count, rejected = decoded(BINARY, [frame(1) + bytes(bad) + frame(3)])
    np.testing.assert_array_equal(count, [1, 3])
    assert rejected[GARBAGE] == SIZE
    assert (DAMAGED in rejected) is (bit >= 16)  # without its sync it was no frame


def test_bad_frames_do_not_make_the_work_grow():
    """Every second frame damaged: what is looked at again stays in proportion (this took minutes otherwise)."""
    bad = frame(2)[:-1] + b"\0"
    _, count, rejected = decoded(BINARY, [(frame(1) + bad) * 3000])
    assert len(count) == 3000
    assert rejected[DAMAGED] == 3000


CHECK = b"123456789"  # the catalogue's check values are of this text


@pytest.mark.parametrize(("kind", "value", "size"), [
    ("CRC-8/SMBUS", 0xF4, 1),
    ("CRC-16/MODBUS", 0x4B37, 2),
    ("CRC-16/XMODEM", 0x31C3, 2),
    ("CRC-16/IBM-3740", 0x29B1, 2),
    ("CRC-16/KERMIT", 0x2189, 2),
    ("CRC-16/ARC", 0xBB3D, 2),
    ("CRC-32/ISO-HDLC", 0xCBF43926, 4),
    ("CRC-32/MPEG-2", 0x0376E6E7, 4),
    ("sum8", sum(CHECK) % 256, 1),
    ("sum16", sum(CHECK) % 65536, 2),
    ("xor8", functools.reduce(operator.xor, CHECK), 1),
])  # fmt: skip
@pytest.mark.parametrize("order", ["big", "little"])
def test_checksums_have_the_values_of_the_catalogue(kind, value, size, order):
    """Check values: Catalogue of parametrised CRC algorithms."""
    decoder = framing(kind="binary", sync="31", byte_order=order, checksum={"kind": kind},
                      fields=[{"name": "v", "type": "uint8", "count": 8}])  # fmt: skip
    good = CHECK + value.to_bytes(size, order)
    channels, _, rejected = decoded(decoder, [good])
    np.testing.assert_array_equal(channels["v"], [list(CHECK[1:])])
    assert not rejected
    worse = CHECK + (value ^ 1).to_bytes(size, order)
    assert decoded(decoder, [worse])[2][DAMAGED] >= 1


def test_types_scales_and_constants():
    decoder = framing(
        kind="binary", sync="EB 90", byte_order="big", end="0D 0A", length=23,
        fields=[
            {"type": "uint8", "equals": 15},
            {"name": "gyro", "type": "int16", "count": 3, "unit": "0.005 deg/s"},
            {"name": "temperature", "type": "uint16", "scale": 0.00565, "offset": 25.0, "unit": "degC"},
            {"type": "uint32"},
            {"name": "voltage", "type": "float32", "unit": "mV"},
        ],
        checksum={"kind": "sum16", "start": 2, "complement": True, "byte_order": "little"},
    )  # fmt: skip

    def one(length=15, end=b"\r\n"):
        body = struct.pack(">B3hHIf", length, 100, -200, 0, 1000, 42, 5000.0)
        return b"\xeb\x90" + body + struct.pack("<H", -sum(body) % 65536) + end

    assert len(one()) == 23
    channels, count, _ = decoded(decoder, [one() + one(length=16) + one(end=b"\r\r") + one()])
    assert count is None
    np.testing.assert_allclose(channels["gyro"], np.deg2rad([[0.5, -1.0, 0.0]] * 2))
    np.testing.assert_allclose(channels["temperature"], [30.65, 30.65])
    np.testing.assert_allclose(channels["voltage"], [5.0, 5.0])


@pytest.mark.parametrize("message", ["A", "B"])
def test_kvh_1775(message):
    """Layout, status and CRC (polynomial 04C11DB7, all ones first, not reflected) by the manual's tables 5-1 to 5-9."""
    decoder = framing(kind="kvh_1775", message=message, interval="10 ms")
    stream = b"".join(kvh(k, message) for k in range(130))
    assert len(stream) == 130 * (36 if message == "A" else 40)
    channels, count, rejected = decoded(decoder, [b"\xfe\x81", stream])
    assert rejected == {GARBAGE: 2}
    np.testing.assert_allclose(channels["gyro"][0], [1e-3, -2e-3, 3e-3], rtol=1e-6)
    np.testing.assert_allclose(channels["accel"][0], [0, 0, 9.80665])
    assert channels["temperature"][0] == 31
    np.testing.assert_array_equal(np.flatnonzero(channels["valid"] == 0), [3])
    assert decoder.device_counter.tick == (1e-6 if message == "B" else None)
    np.testing.assert_array_equal(count, np.arange(130) * 10_000 if message == "B" else np.arange(130) % 128)
    with pytest.raises(ValidationError, match="the unit sends angles and not rates unless configured otherwise"):
        framing(kind="kvh_1775")
    fahrenheit = framing(kind="kvh_1775", output="rate", angle="deg", temperature="0.01 degF", message=message)
    channels = decoded(fahrenheit, [kvh(0, message, 7700)])[0]
    np.testing.assert_allclose(channels["temperature"], 25.0)
    np.testing.assert_allclose(channels["gyro"][0], np.deg2rad([1e-5, -2e-5, 3e-5]), rtol=1e-6)


TEXT = {
    "kind": "text",
    "columns": ["n", "gx", "gy", "gz", "T"],
    "channels": {
        "gyro": {"path": ["gx", "gy", "gz"], "unit": "deg/s"},
        "temperature": {"path": "T", "unit": "degC"},
    },
    "counter": {"field": "n", "modulo": 256},
}


@settings(max_examples=draws(60, 200))
@given(
    st.lists(st.one_of(
        st.integers(0, 255),
        st.sampled_from([b"\n", b"boot v1.2\n", b"1,2,3\n", b"1,2,3,4,x\n", b"\xff\xfe,1\n", b"9" * 5000 + b"\n",
                         b"nan,1,2,3,4\n", b"1,2,3,4,5,6\r\n"]),
    ), max_size=12),
    st.lists(st.integers(0, 12000), max_size=20),
)  # fmt: skip
def test_whole_lines_come_out_and_nothing_else(pieces, cuts):
    lines = [b"%d,0.5,-1,2e-1,25.5\r\n" % p if isinstance(p, int) else p for p in pieces]
    stream = b"12.5\n" + b"".join(lines)
    pieces_of = cut(stream, cuts)
    channels, count, rejected = decoded(framing(**TEXT), pieces_of)
    sent = [p for p in pieces if isinstance(p, int)]
    np.testing.assert_array_equal(count, sent)
    np.testing.assert_allclose(channels["gyro"], np.deg2rad(np.tile([0.5, -1, 0.2], (len(sent), 1))))
    assert rejected.get(GARBAGE, 0) == len(stream) - sum(len(b"%d,0.5,-1,2e-1,25.5\r\n" % n) for n in sent)


def test_the_first_line_is_not_trusted_without_its_beginning():
    line = b"5,1,2,3,25\n"
    assert list(decoded(framing(**TEXT), [line * 2])[1]) == [5]
    prefixed = framing(**TEXT, prefix="$G,")
    assert list(decoded(prefixed, [(b"$G," + line) * 2])[1]) == [5, 5]


def test_a_header_names_the_columns():
    config = {key: value for key, value in TEXT.items() if key != "columns"}
    stream = b"T;gz;n;gy;gx\n20;3;1;2;1\n" + b"n;gx;gy;gz;T\n2;4;5;6;21\n"
    channels, count, _ = decoded(framing(**config, separator=";"), [stream])
    np.testing.assert_allclose(channels["gyro"], np.deg2rad([[1, 2, 3], [4, 5, 6]]))
    np.testing.assert_array_equal(count, [1, 2])
    with pytest.raises(MissingChannel, match="the device's header has no column 'T', it has n, gx, gy, gz, temp"):
        framing(**config).decode(b"\nn,gx,gy,gz,temp\n", None)
    for torn in (b"gx,gy,gz,T\n", b"\n1,2,3e,gx,gy,gz,T\n"):  # its beginning is lost, or is that of a sample
        frames, _ = framing(**config).decode(torn + b"n,gx,gy,gz,T\n2,4,5,6,21\n", None)
        np.testing.assert_array_equal(frames.count, [2])
    with pytest.raises(ValidationError, match="no column is called 'T'; columns are n, gx, gy, gz"):
        framing(**{**TEXT, "columns": ["n", "gx", "gy", "gz"]})


def test_the_checksum_of_nmea():
    """The sentence and its checksum are those of the article on NMEA 0183: $GPAAM,A,A,0.10,N,WPTNME*32."""
    assert functools.reduce(operator.xor, b"GPAAM,A,A,0.10,N,WPTNME") == 0x32
    body = b"IMU,7,1,2,3,25"
    good = b"$%s*%02X\r\n" % (body, functools.reduce(operator.xor, body))
    decoder = framing(**TEXT, prefix="$IMU,", checksum="nmea")
    _, count, rejected = decoded(decoder, [good + good.replace(b"25", b"26") + good + b"$IMU,1,2,3,4,5\n"])
    np.testing.assert_array_equal(count, [7, 7])
    assert rejected == {DAMAGED: 1, GARBAGE: 15}


@pytest.mark.parametrize(("change", "message"), [
    ({"sync": "A5 5"}, "'A5 5' are no bytes; write them as text in hexadecimal"),
    ({"length": 60}, f"length is 60 and the fields add up to {SIZE} bytes; correct one of them"),
    ({"sync": ""}, "sync is empty; write the bytes that every frame begins with"),
    ({"checksum": {"kind": "CRC-16/MODBUSS"}}, "did you mean 'CRC-16/MODBUS'"),
    ({"checksum": {"kind": "sum8", "start": 60}}, "checksum: start 60 is behind the fields"),
    ({"counter": {"field": "count", "modulo": 256}}, "counter: no field is called 'count'; fields are sequence, gyro"),
    ({"fields": [{"name": "gyro", "type": "int16"}]}, "channel gyro has no unit; write unit: deg/s"),
    ({"fields": [{"name": "gyro", "type": "int16", "unit": "deg"}]}, "channel gyro: unit 'deg' cannot be converted to"),
    ({"fields": [{"name": "v", "type": "int16", "unit": "volts per"}]}, "channel v: unit 'volts per' is not known"),
    ({"fields": [{"name": "gyro", "type": "int16", "count": 4, "unit": "dps"}]}, "channel gyro has 4 axes, at most 3"),
    ({"fields": [{"name": "v", "type": "int8"}, {"name": "v", "type": "int8"}]}, "two fields are called 'v'"),
])  # fmt: skip
def test_a_wrong_description_says_what_to_write(change, message):
    with pytest.raises(ValidationError) as caught:
        framing(**{**FRAMING, **change})
    assert message in str(caught.value)


class Triples(Framing):
    """Three rates in deg/s a line: the framing of the guide."""

    kind: Literal["triples"] = "triples"

    def decode(self, data, memory):
        *lines, rest = ((memory or b"") + data).split(b"\n")
        rows = [[float(cell) for cell in line.split(b",")] for line in lines if line.count(b",") == 2]
        gyro = np.deg2rad(np.array(rows).reshape(-1, 3))
        return Frames(len(gyro), {"gyro": gyro}), rest


def test_a_third_party_adds_a_framing():
    module = types.ModuleType("triples")

    @hookimpl
    def framings():
        return [Triples]

    module.framings = framings
    found = Registry()
    found.register(module)
    assert found.classes(Framing) == {"triples": Triples}
    channels, count, _ = decoded(Triples(), [b"1,2,", b"3\nboot\n4,5,6\n7"])
    np.testing.assert_allclose(channels["gyro"], np.deg2rad([[1, 2, 3], [4, 5, 6]]))
    assert count is None


def test_hours_of_frames_in_flat_memory():
    """6 h at 100 Hz at full speed, as reads of 16 kB, with a torn frame and noise every hour: nothing piles up."""
    resource = pytest.importorskip("resource", reason="memory of a process is asked of POSIX")
    rate, hours, read = 100, 6, 16_384
    minute = b"".join(frame(k) for k in range(60 * rate))
    dirt = frame(1)[:20] + SYNC + bytes(100)
    found, memory, rest, peaks = 0, None, b"", []
    for k in range(hours * 60):
        data = rest + minute + (dirt if k % 60 == 0 else b"")
        whole = len(data) - len(data) % read
        for at in range(0, whole, read):
            frames, memory = BINARY.decode(data[at : at + read], memory)
            found += frames.N
            assert len(memory) < SIZE
        rest = data[whole:]
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert found + BINARY.decode(rest, memory)[0].N == hours * 3600 * rate
    assert peaks[-1] - peaks[60] < 1800  # kB, a byte a frame


@pytest.mark.parametrize("code", [0x00, 0x0B, 0x1C, 0x1D, 0x1E, 0x1F, 0x7F])
def test_a_control_character_in_a_line_is_damage_and_no_space(code):
    decoder = framing(kind="text", columns=["a", "b"], channels={"gyro": {"path": "b", "unit": "rad/s"}})
    frames, _ = decoder.decode(b"0,0\n1,2\n3,4" + bytes([code]) + b"\n5,6\n", None)
    assert frames.channels["gyro"].ravel().tolist() == [2.0, 6.0]


def test_a_framing_that_encodes_nothing_says_so():
    class OnlyRead(Framing):
        kind: Literal["only_read"] = "only_read"

        def decode(self, data, memory):
            raise NotImplementedError

    with pytest.raises(ConfigError, match="only_read: is a framing that can only be read; serve lines of text instead"):
        OnlyRead().encode(Chunk(np.arange(3.0), {}), 0)


def test_numbers_that_a_type_cannot_hold_stay_at_its_ends():
    fields = [{"name": "temperature", "type": "int8", "unit": "degC"}]
    device = framing(kind="binary", sync="A5 5A", fields=fields, checksum={"kind": "sum8"}, end="0D 0A")
    T = np.array([-300.0, -5.4, 21.6, 300.0])
    frames, _ = device.decode(device.encode(Chunk(np.arange(4.0), {"temperature": T}), 0), None)
    np.testing.assert_array_equal(frames.channels["temperature"], [-128, -5, 22, 127])


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_lines_are_encoded_as_a_config_names_them(separator):
    columns, channels = ["n", "T", "other"], {"temperature": {"path": "T", "unit": "degF"}}
    device = framing(
        kind="text", separator=separator, columns=columns, prefix="$IMU,", checksum="nmea", channels=channels,
        counter={"field": "n", "modulo": 4},
    )  # fmt: skip
    samples = Chunk(np.arange(6.0), {"temperature": np.array([0.0, 10.0, 20.0, -40.0, 100.0, 37.0])})
    encoded = device.encode(samples.part(0, 2), 0) + device.encode(samples.part(2, 6), 2)
    frames, _ = device.decode(encoded, None)
    np.testing.assert_allclose(frames.channels["temperature"], samples["temperature"], atol=1e-12)
    np.testing.assert_array_equal(frames.count, [0, 1, 2, 3, 0, 1])
    assert encoded.startswith(f"$IMU,0{separator}32.0".encode())
    assert not frames.rejected
