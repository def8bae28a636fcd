"""GNU Octave, which reads and writes MAT files by a code of its own."""

import os
import shutil
import subprocess

import pytest


def octave(script: str, folder) -> str:
    """Return what a script prints that runs in a folder; the test is skipped where there is no Octave, never in CI."""
    path = shutil.which("octave-cli")
    if path is None:
        if os.environ.get("CI"):
            pytest.fail("no octave-cli: `make tools` installs it")
        pytest.skip("no octave-cli is installed; `make tools` installs it")
    command = [path, "--quiet", "--no-init-file", "--no-history", "--eval", script]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
