"""One thread prepares what another one uses: a recording is read while the filter runs on what was read before."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable
from queue import Empty, Full, Queue
from typing import TypeVar

Item = TypeVar("Item")
WAIT = 0.1  # s between looks whether the other side is still there
LONGEST = 5.0  # s that the end of an item is waited for: its maker may read what nobody writes any more


def ahead(items: Iterable[Item], depth: int = 2) -> Generator[Item]:
    """Yield the same items, up to `depth` of them made in a second thread before they are asked for.

    What the items' maker raises is raised here, in its place. The order of work is the only thing that changes:
    NumPy, h5py and the compiled loops let both threads run. Close what is returned (`contextlib.closing`) where it may
    be left before its end; the second thread ends with the program all the same.
    """
    queue: Queue[tuple[bool, Item | BaseException | None]] = Queue(depth)
    left = threading.Event()

    def ended() -> bool:
        return left.is_set() or not threading.main_thread().is_alive()

    def put(entry: tuple[bool, Item | BaseException | None]) -> None:
        while not ended():
            try:
                queue.put(entry, timeout=WAIT)
            except Full:
                continue
            return

    def work() -> None:
        try:
            for item in items:
                put((True, item))
                if ended():
                    break
            else:
                put((False, None))
        except BaseException as error:
            put((False, error))
        finally:
            if isinstance(items, Generator):
                items.close()  # a file that it reads, too: here, and not when the program ends

    # no daemon: one that is stopped within a call of h5py keeps its lock, and the end of the program waits for that
    thread = threading.Thread(target=work)
    thread.start()
    try:
        while True:
            try:
                more, item = queue.get(timeout=WAIT)  # in slices, so that an interrupt is heard
            except Empty:
                continue
            if more:
                yield item  # type: ignore[misc]
            elif item is None:
                return
            else:
                raise item  # type: ignore[misc]
    finally:
        left.set()
        thread.join(LONGEST)
