"""What all tests share: where the measured recordings are, and small recordings made for a test."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the measured recordings; the test is skipped where there is none."""
    folder = os.environ.get("DRIFTLAB_DATA")
    if not folder:
        pytest.skip("DRIFTLAB_DATA does not name a folder of measured recordings")
    return Path(folder)
