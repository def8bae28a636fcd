"""Recordings on standard input, by the program as a process of its own."""

import os
import signal
import subprocess
import sys

import pytest

CONFIG = """
source:
  kind: csv
  path: "-"
  channels:
    time: {path: t, unit: s}
    gyro: {path: g, unit: rad/s}
"""
MAIN = "from driftlab.cli import main; main()"
ROWS = b",\n" * 100_000  # none of which can be used, so that no number of them is enough
MORE = 20  # times ROWS: more than pipes and buffers hold


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_stopped_leaves_nothing_of_what_was_piped_in(tmp_path, number):
    (tmp_path / "config.yaml").write_text(CONFIG)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    command = subprocess.Popen(
        [sys.executable, "-c", MAIN, "allan", "config.yaml", "--input", "-"], cwd=tmp_path, stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "TMPDIR": str(temporary)},
    )  # fmt: skip
    assert command.stdin is not None
    command.stdin.write(b"t,g\n" + MORE * ROWS)
    command.send_signal(number)
    out, err = command.communicate()
    assert (command.returncode, out) == (130, b"")
    assert err.startswith(b"driftlab: interrupted; ")
    assert err.count(b"\n") == 1
    assert list(temporary.iterdir()) == []
