"""Programs that tests run: a browser, compilers, an emulator."""

import os
import shutil

import pytest


def tool(*names: str) -> str:
    """Return the path of the first of these programs that is installed; skip without, but never in CI."""
    for name in names:
        path = shutil.which(name)
        if path:
            return path
    missing = f"{names[0]} is not installed; `make tools` installs it"
    if os.environ.get("CI"):
        pytest.fail(missing)
    pytest.skip(missing)
