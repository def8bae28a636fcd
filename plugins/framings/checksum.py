"""Checksums at the end of a frame: sums, exclusive or, and the CRCs of the catalogue.

CRCs go by their names in the *Catalogue of parametrised CRC algorithms* (reveng.sourceforge.io/crc-catalogue), as in
`CRC-32/MPEG-2`; the library `fastcrc` computes them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from fusion_core.settings import Settings, nearest

Bytes = NDArray[np.uint8]
SIMPLE = {"sum8": 1, "sum16": 2, "xor8": 1}  # kinds that need no table: their size in bytes


class Checksum(Settings):
    """What follows the fields of a frame and says whether it is whole."""

    kind: str
    """Name: sum8, sum16, xor8, or a CRC of the catalogue."""
    start: Annotated[int, Field(ge=0, le=1 << 16)] = 0
    """First byte that is covered; the frame's first is 0."""
    byte_order: Literal["big", "little"] | None = None
    """Byte order of the checksum; that of the frame where nothing is said."""
    complement: bool = False
    """Whether what is sent is the two's complement, so that all bytes add up to zero."""

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.kind not in SIMPLE and _crc(self.kind) is None:
            hint = nearest(self.kind, names())
            advice = f"did you mean '{hint}'?" if hint else "write e.g. CRC-16/MODBUS"
            text = f"checksum '{self.kind}' is neither one of {', '.join(SIMPLE)} nor a CRC of the catalogue; {advice}"
            raise PydanticCustomError("checksum", "{text}", {"text": text})
        return self

    @cached_property
    def size(self) -> int:
        """How many bytes it has."""
        return SIMPLE.get(self.kind) or int(self.kind.split("/")[0].removeprefix("CRC-")) // 8

    @cached_property
    def _crc(self) -> Callable[[bytes], int]:
        found = _crc(self.kind)
        assert found is not None, "the kind was checked"
        return found

    def good(self, frames: Bytes, order: Literal["big", "little"]) -> NDArray[np.bool_]:
        """Return which of the frames (N, L) end with the checksum of what comes before it (N,)."""
        body, sent = frames[:, self.start : -self.size], frames[:, -self.size :]
        sent = sent if (self.byte_order or order) == "big" else sent[:, ::-1]
        value = np.zeros(len(frames), dtype=np.int64)
        for k in range(self.size):
            value = value << 8 | sent[:, k]
        return np.asarray(value == self._of(body), dtype=np.bool_)

    def _of(self, body: Bytes) -> NDArray[np.int64]:
        if self.kind == "xor8":
            return np.asarray(np.bitwise_xor.reduce(body, axis=1), dtype=np.int64)
        if self.kind in SIMPLE:
            total = np.sum(body, axis=1, dtype=np.int64)
            return np.asarray((-total if self.complement else total) % (1 << 8 * self.size), dtype=np.int64)
        crc = self._crc
        n, text = body.shape[1], body.tobytes()
        return np.array([crc(text[k : k + n]) for k in range(0, len(text), n)], dtype=np.int64)


def _crc(name: str) -> Callable[[bytes], int] | None:
    import fastcrc

    found = re.fullmatch(r"CRC-(8|16|32)/([A-Z0-9][A-Z0-9-]*)", name)
    if found is None:
        return None
    module = getattr(fastcrc, f"crc{found[1]}")
    algorithm = found[2].lower().replace("-", "_")
    return getattr(module, algorithm) if algorithm in module.algorithms_available else None


def names() -> list[str]:
    """Return every kind of checksum."""
    import fastcrc

    crcs = [
        f"CRC-{width}/{algorithm.upper().replace('_', '-')}"
        for width in (8, 16, 32)
        for algorithm in sorted(getattr(fastcrc, f"crc{width}").algorithms_available)
    ]
    return [*SIMPLE, *crcs]
