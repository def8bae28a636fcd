"""A device that is not there, heard at its other end as a serial port is."""

import builtins
import os
import threading
import time

import numpy as np
import pytest

from driftlab.live import pseudo_terminal
from driftlab.live.pseudo_terminal import PseudoTerminal, served_at
from fusion_core.chunk import Chunk
from fusion_core.errors import ConfigError
from fusion_plugins.framings.text import Text

LINES = Text.model_validate({"columns": ["t"], "channels": {"time": {"path": "t", "unit": "s"}}})


@pytest.fixture
def terminal():
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    made = PseudoTerminal()
    yield made
    made.close()


def test_bytes_pass_as_they_are_and_those_of_no_listener_are_lost(terminal):
    terminal.send(b"nobody")
    assert (terminal.heard, terminal.lost) == (False, 6)
    other = os.open(terminal.device, os.O_RDWR | os.O_NOCTTY)
    terminal.wait()
    every = bytes(range(256))
    terminal.send(every)
    assert os.read(other, 1000) == every
    terminal.send(bytes(1 << 20))
    assert terminal.lost > 6
    os.close(other)
    assert not terminal.heard


def test_samples_are_sent_when_they_are_due(terminal):
    other = os.open(terminal.device, os.O_RDWR | os.O_NOCTTY)
    terminal.wait()
    due, arrived = 5.0 + np.arange(20) * 0.5, []

    def listen():
        rest = b""
        while len(arrived) < len(due):
            *lines, rest = (rest + os.read(other, 1000)).split(b"\n")
            arrived.extend((float(line), time.monotonic()) for line in lines)

    listener = threading.Thread(target=listen)
    listener.start()
    zero = time.monotonic() - 5.0 / 20
    terminal.play(Chunk(due, {}), LINES, 0, 20.0, zero)
    listener.join()
    os.close(other)
    np.testing.assert_allclose([t for t, _ in arrived], due)
    assert all(at - zero >= t / 20 for t, at in arrived), "a sample came before it was measured"


def test_a_link_lasts_as_long_as_the_device(tmp_path):
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    link = tmp_path / "port"
    link.symlink_to("/dev/pts/987654")  # of one that was killed
    with served_at(link) as terminal:
        assert os.readlink(link) == terminal.device
    assert not link.is_symlink()
    link.write_text("mine")
    with pytest.raises(ConfigError, match="cannot be linked"), served_at(link):
        pass
    assert link.read_text() == "mine"


def test_a_system_without_pseudo_terminals_says_so(monkeypatch):
    whole = builtins.__import__

    def without(name, *rest):
        if name in ("pty", "tty", "termios"):
            raise ImportError(name)
        return whole(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match="no pseudo-terminals, a POSIX system was expected; write a file with --out"):
        pseudo_terminal.PseudoTerminal()
