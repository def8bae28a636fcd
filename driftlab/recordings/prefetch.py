"""One thread prepares what another one uses: a recording is read while the filter runs on what was read before."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable
from queue import Empty, Full, Queue
from typing import Generic, TypeVar

Item = TypeVar("Item")
WAIT = 0.1  # s between looks whether the other side is still there
LONGEST = 5.0  # s that the end of an item is waited for: its maker may read what nobody writes any more


def ahead(items: Iterable[Item], depth: int = 2) -> Generator[Item]:
    """Yield the same items, up to `depth` of them made in a second thread before they are asked for.

    What the items' maker raises is raised here, in its place. The order of work is the only thing that changes:
    NumPy, h5py and the compiled loops let both threads run. Close what is returned (`contextlib.closing`) where it may
    be left before its end; the second thread ends with the program all the same.
    """
    maker = _Maker(items, depth)
    # no daemon: one that is stopped within a call of h5py keeps its lock, and the end of the program waits for that
    thread = threading.Thread(target=maker.work)
    thread.start()
    try:
        while True:
            try:
                more, item = maker.queue.get(timeout=WAIT)  # in slices, so that an interrupt is heard
            except Empty:
                continue
            if more:
                yield item  # type: ignore[misc]
            elif item is None:
                return
            else:
                raise item  # type: ignore[misc]
    finally:
        maker.left.set()
        thread.join(LONGEST)


class _Maker(Generic[Item]):
    """The second thread: it puts (True, item) into the queue, and (False, what was raised or None) at the end."""

    def __init__(self, items: Iterable[Item], depth: int) -> None:
        self.items = items
        self.queue: Queue[tuple[bool, Item | BaseException | None]] = Queue(depth)
        self.left = threading.Event()

    def work(self) -> None:
        """Make the items until there are no more, or nobody wants them."""
        try:
            for item in self.items:
                self._put((True, item))
                if self._ended():
                    break
            else:
                self._put((False, None))
        except BaseException as error:
            self._put((False, error))
        finally:
            if isinstance(self.items, Generator):
                self.items.close()  # a file that it reads, too: here, and not when the program ends

    def _put(self, entry: tuple[bool, Item | BaseException | None]) -> None:
        while not self._ended():
            try:
                self.queue.put(entry, timeout=WAIT)
            except Full:
                continue
            return

    def _ended(self) -> bool:
        return self.left.is_set() or not threading.main_thread().is_alive()
