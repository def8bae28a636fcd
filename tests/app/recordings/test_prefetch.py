"""Making items in a second thread changes neither their order nor what goes wrong."""

import subprocess
import sys
import threading
import time

import pytest

from driftlab.recordings.prefetch import aside, prefetch


def test_the_same_items_in_the_same_order():
    assert list(prefetch(iter(range(1000)))) == list(range(1000))
    assert list(prefetch([])) == []


def test_what_the_maker_raises_comes_in_its_place():
    def three():
        yield from (1, 2, 3)
        raise ValueError("four")

    seen = []
    with pytest.raises(ValueError, match="four"):
        seen.extend(item for item in prefetch(three()))
    assert seen == [1, 2, 3]


def test_items_are_made_in_another_thread_and_not_without_bound():
    made = []

    def endless():
        while True:
            made.append(threading.current_thread())
            yield len(made)

    stream = prefetch(endless(), depth=2)
    assert next(stream) == 1
    stream.close()
    assert made[0] is not threading.current_thread()
    assert len(made) <= 5
    assert not made[0].is_alive()


def test_the_second_thread_ends_with_the_program_and_closes_what_it_reads():
    code = """
import time
from driftlab.recordings.prefetch import prefetch
def made():
    try:
        while True:
            time.sleep(0.02)
            yield 1
    finally:
        print("closed")
for item in prefetch(made()):
    raise ZeroDivisionError
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (1, "closed\n")


def test_what_is_done_aside_is_in_order_and_its_error_comes_back():
    """No more than `depth` of them wait, so that a slow one holds up who asks, and no memory grows."""
    done, go, waiting = [], threading.Event(), []

    def slow(item):
        go.wait(10)
        done.append(item)

    with aside(depth=2) as do:
        asked = threading.Thread(target=lambda: [waiting.append(do(slow, k)) for k in range(5)])
        asked.start()
        time.sleep(0.2)
        assert len(waiting) == 2
        go.set()
        asked.join(10)
    assert done == [0, 1, 2, 3, 4]

    with pytest.raises(ZeroDivisionError), aside() as do:
        do(lambda item: 1 / item, 0)
