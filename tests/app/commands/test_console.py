"""Lines that commands print beside their results."""

from time import sleep

from numba.core import event

from driftlab.commands import console


def test_compiling_is_not_announced_where_nobody_asks(monkeypatch, capsys):
    monkeypatch.setattr(console, "COMPILED", float("inf"))  # as the other tests have it
    console.note_compiling()
    with event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
        sleep(0.1)  # a failure in a thread fails the test
    assert capsys.readouterr().err == ""


def test_compiling_is_announced_once_on_standard_error(monkeypatch, capsys):
    monkeypatch.setattr(console, "COMPILED", 0.5)
    for _ in range(2):  # as two commands of one process do
        console.note_compiling()
    with event.trigger_event("numba:compile"):
        pass
    assert capsys.readouterr().err == ""  # of a moment nobody needs to know
    for _ in range(2):
        with event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
            sleep(0.8)
    printed = capsys.readouterr()
    assert printed.err.startswith("compiling the filter for this processor")
    assert printed.err.count("compiling the filter") == 1
    assert printed.out == ""
