"""Threads beside the one that filters: before it one reads the recording, after it one looks at what it has made."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from queue import Empty, Full, Queue
from typing import Any, TypeVar

Item = TypeVar("Item")
WAIT = 0.1  # s between looks whether the other side is still there
LONGEST = 5.0  # s that the end of an item is waited for: its maker may read a pipe whose writer has stopped


def prefetch(items: Iterable[Item], depth: int = 2) -> Generator[Item]:
    """Yield the same items, up to `depth` of them made in a second thread before they are asked for.

    Errors of the items' maker are raised here, in their place. The order of work is the only thing that changes:
    NumPy, h5py and the compiled loops let both threads run. Close the generator (`contextlib.closing`) where it may
    be left before its end; the second thread ends with the program all the same.
    """
    queue, left = Queue[tuple[bool, Any]](depth), threading.Event()
    # no daemon: one that is stopped within a call of h5py keeps its lock, and the end of the program waits for that
    thread = threading.Thread(target=_make, args=(items, queue, left))
    thread.start()
    try:
        while True:
            try:
                more, item = queue.get(timeout=WAIT)  # in slices, so that an interrupt is heard
            except Empty:
                continue
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        left.set()
        thread.join(LONGEST)


def _make(items: Iterable[Any], queue: Queue[tuple[bool, Any]], left: threading.Event) -> None:
    """Put (True, item) into the queue for each item, and (False, the error or None) at the end."""

    def wanted() -> bool:
        return not left.is_set() and threading.main_thread().is_alive()

    def put(*entry: Any) -> None:
        while wanted():
            with suppress(Full):
                queue.put(entry, timeout=WAIT)
                return

    try:
        for item in items:
            put(True, item)
            if not wanted():
                break
        else:
            put(False, None)
    except BaseException as error:
        put(False, error)
    finally:
        if isinstance(items, Generator):
            items.close()  # a file that it reads, too: here, and not when the program ends


@contextmanager
def aside(depth: int = 4) -> Iterator[Callable[[Callable[[Item], object], Item], None]]:
    """Give a callable that has another thread do `function(item)`, one after the other, up to `depth` of them later.

    It raises the error of an earlier one.
    """
    with ThreadPoolExecutor(1) as thread:
        under_way: deque[Future[object]] = deque()

        def do(function: Callable[[Item], object], item: Item) -> None:
            while under_way and (len(under_way) >= depth or under_way[0].done()):
                under_way.popleft().result()
            under_way.append(thread.submit(function, item))

        yield do
        for one in under_way:
            one.result()
