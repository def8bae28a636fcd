"""The contract of sources: where samples come from."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

from fusion_core.chunk import Chunk
from fusion_core.contracts.plugin import Plugin
from fusion_core.faults import Faults


class Source(Plugin):
    """Where samples come from."""

    live: ClassVar[bool] = False  # whether samples come as they are measured, without an end

    @abstractmethod
    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the recording as chunks of at most `size` samples, in SI units.

        A live source yields what has come at once, and an empty chunk when nothing has for a second, so that its
        reader can look up. A source gives what it has, NaN included: rows that cannot be used are left out, the same
        way for every source, by `fusion_core.faults.usable`. What only the source can see (a torn line) it reports to
        `faults`; a live one that knows why nothing comes says so in `faults.unavailable` as long as it lasts.
        """

    def about(self, channel: str) -> Mapping[str, str]:
        """Return what the recording says of the device that a channel is of, by name, for the record of its map."""
        return {}

    def of_file(self, path: Path) -> Source | None:
        """Return the source that reads from a file the bytes that a live one would have heard; None where none can."""
        return None

    @property
    def name(self) -> str:
        """What the source is called in messages and provenance, e.g. its path."""
        return self.kind
