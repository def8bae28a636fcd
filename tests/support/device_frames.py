"""Frames of VectorNav, Xsens and KVH units, packed byte by byte: nothing of the decoders is used."""

import struct

from driftlab.config import understood
from fusion_core.host.config import document_of
from fusion_core.host.registry import registry


def crc_of_vectornav(data):
    """CRC-16/XMODEM bit by bit: polynomial 1021, zero first, highest bit first."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return struct.pack(">H", crc)


def vectornav(ns, accel=(0.0, 0.0, -9.8), gyro=(0.01, -0.02, 0.03), temperature=31.5):
    body = bytes.fromhex("05 0100 1C00") + struct.pack("<Q7f", ns, *accel, *gyro, temperature)
    return b"\xfa" + body + crc_of_vectornav(body)


def xsens(*items):
    body = b"".join(struct.pack(">HB", identifier, len(data)) + data for identifier, data in items)
    head = b"\xff\x36" + (bytes([len(body)]) if len(body) < 255 else b"\xff" + struct.pack(">H", len(body)))
    return b"\xfa" + head + body + bytes([-sum(head + body) % 256])


def one(k, temperature=None, number=">3f", more=0, gyro=None):
    items = [(0x1020, struct.pack(">H", k % 65536)), (0x1060, struct.pack(">I", 100 * k % 2**32))]
    items += [] if temperature is None else [(0x0810, struct.pack(">f", temperature))]
    wide = more | (3 if number == ">3d" else 0)
    return xsens(
        *items,
        (0x4020 | wide, struct.pack(number, 0, 0, 9.8)),
        (0x8020 | wide, struct.pack(number, *(gyro if gyro is not None else (k, 0, -k)))),
    )


def kvh(k, message, temperature=31, angle=(1e-5, -2e-5, 3e-5), accel=(0.0, 0.0, 1.0), us=10_000):
    head = bytes.fromhex("FE81FF55" if message == "A" else "FE81FF56")
    body = head + struct.pack(">6f", *angle, *accel)
    body += struct.pack(">I", k * us % 2**32) if message == "B" else b""
    body += struct.pack(">BBh", 0x77 if k != 3 else 0x76, k % 128, temperature)
    crc = 0xFFFFFFFF
    for byte in body:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc & 1 << 31 else 0)) & 0xFFFFFFFF
    return body + struct.pack(">I", crc)


def source_of(name, source):
    content = {"extends": name, "source": source}
    return understood(document_of(content, registry().products())).source
