"""GNU Octave, which reads and writes MAT files by a code of its own."""

import subprocess

from tools import tool


def octave(script: str, folder) -> str:
    """Return what a script prints that runs in a folder; the test is skipped where there is no Octave, never in CI."""
    command = [tool("octave-cli"), "--quiet", "--no-init-file", "--no-history", "--eval", script]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
