"""Recordings in Arrow files: what a kind of file adds to `FileSource`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import polars as pl

from fusion_core.contracts import Block, FileSource, Source, Table, foreign, head
from fusion_core.errors import BadValue, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl


class Arrow(FileSource):
    """An Arrow IPC file (Feather, version 2): the paths of channels are its columns."""

    kind: Literal["arrow"] = "arrow"

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        first = head(path)
        if not first.startswith(b"ARROW1"):
            raise foreign(path, first, self.kind)
        try:
            yield Columns(path)
        except pl.exceptions.PolarsError as error:
            raise UnreadableFile(f"{path}: is cut short or damaged ({error}); copy or record it again") from None


class Columns(Table):
    """The columns of an open file."""

    def __init__(self, path: Path) -> None:
        self.path, self.frame = path, pl.scan_ipc(path)
        self.schema, self.rows = self.frame.collect_schema(), self.frame.select(pl.len()).collect().item()

    @property
    def names(self) -> Sequence[str]:
        return self.schema.names()

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        for path in paths:
            if not self.schema[path].is_numeric():
                raise BadValue(
                    f"{self.path}: column '{path}' is {self.schema[path]}, numbers were expected; name another"
                )
        numbers = self.frame.select(pl.col(*paths).cast(pl.Float64))
        for start in range(0, self.rows, size):
            block = numbers.slice(start, size).collect()
            yield Block(len(block), lambda path, block=block: block[path].to_numpy())


@hookimpl
def sources() -> list[type[Source]]:
    return [Arrow]
