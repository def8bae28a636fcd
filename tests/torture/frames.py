"""Frames of devices, packed from the formats' definitions, and streams of them that are damaged."""

from __future__ import annotations

import struct
import zlib
from functools import cache, reduce
from operator import xor

import numpy as np

RNG = np.random.Generator
SYNC = b"\xa5\x5a"


@cache
def crc_table() -> list[int]:
    """Return the table of CRC-32/MPEG-2: polynomial 04C11DB7, no reflection, from FFFFFFFF, no final exclusive or."""
    table = []
    for byte in range(256):
        crc = byte << 24
        for _ in range(8):
            crc = ((crc << 1) ^ 0x04C11DB7 if crc & 0x80000000 else crc << 1) & 0xFFFFFFFF
        table.append(crc)
    return table


def mpeg_2(data: bytes) -> int:
    """Return CRC-32/MPEG-2."""
    table = crc_table()
    return reduce(lambda crc, byte: ((crc << 8) & 0xFFFFFFFF) ^ table[(crc >> 24) ^ byte], data, 0xFFFFFFFF)


def frame(name: str, k: int, gyro: tuple[float, ...], T: float) -> bytes:
    """Return the bytes of a sample."""
    match name:
        case "text" | "header":
            return ",".join([f"{k % 1000}", *(f"{w:.6e}" for w in gyro), f"{T:.2f}"]).encode() + b"\r\n"
        case "nmea":
            body = "IMU," + ",".join([f"{k % 1000}", *(f"{w:.6e}" for w in gyro), f"{T:.2f}"])
            return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n".encode()
        case "kvh_a" | "kvh_b":
            scale, stamp = (0.01, b"") if name == "kvh_a" else (1.0, struct.pack(">I", k * 10_000 % 2**32))
            head = bytes.fromhex("FE81FF55" if name == "kvh_a" else "FE81FF56")
            body = (
                head
                + struct.pack(">6f", *(w * scale for w in gyro), 0, 0, 1)
                + stamp
                + struct.pack(">BBh", 0x77, k % 128, int(T))
            )
            return body + struct.pack(">I", mpeg_2(body))
    body = SYNC + struct.pack("<B3fh", k % 256, *gyro, round(T * 100))
    if name == "binary":
        return body + struct.pack("<I", zlib.crc32(body))
    return body + (bytes([sum(body) % 256]) + b"\r\n" if name == "sum" else b"")


def stream(name: str, rng: RNG) -> bytes:
    """Return bytes: noise, or frames with noise, flips, cuts, repeats and long lines."""
    if rng.random() < 0.1:
        alphabet = [
            bytes(range(256)),
            b"0123456789.,-+eE\r\n$*IMUnaif_ ",
            SYNC + b"\x00\xff\r\n",
            bytes.fromhex("FE81FF5556"),
        ][rng.integers(4)]
        return bytes(rng.choice(np.frombuffer(alphabet, np.uint8), int(rng.integers(0, 600))))
    parts = [b"t,gx,gy,gz,T\r\n"] if name == "header" and rng.random() < 0.9 else []
    first = int(rng.integers(0, 2000))
    for k in range(int(rng.integers(1, 12))):
        special = rng.random() < 0.03
        gyro = tuple(
            float(rng.choice([np.nan, np.inf, 1e38, -0.0, 1e-40])) if special else float(w) for w in rng.normal(size=3)
        )
        parts.append(frame(name, first + k, gyro, float(rng.integers(-40, 85))))
    raw = bytearray(b"".join(parts))
    for _ in range(int(rng.integers(0, 4))):
        k = int(rng.integers(len(raw) + 1))
        match rng.integers(6):
            case 0 if len(raw):
                raw[k % len(raw)] ^= 1 << int(rng.integers(8))
            case 1:
                raw[k:k] = bytes(rng.integers(0, 256, int(rng.integers(1, 30)), dtype=np.uint8))
            case 2:
                del raw[k : k + int(rng.integers(1, 30))]
            case 3:
                raw[k:k] = [
                    SYNC,
                    b"\n",
                    b"\r",
                    b",",
                    b"_",
                    b"1_0",
                    b"$IMU,",
                    b"t,gx,gy,gz,T\n",
                    b"\x00",
                    b"e999",
                    b"1e300,",
                ][rng.integers(11)]
            case 4:
                raw[k:k] = raw[: int(rng.integers(1, 60))]
            case _ if rng.random() < 0.05:
                raw[k:k] = [b"1", b"\n", SYNC[:1], b"x,"][rng.integers(4)] * 6000
    return bytes(raw[rng.integers(0, 20) :] if rng.random() < 0.3 else raw)
