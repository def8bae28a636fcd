"""Fixtures that all tests share: the folder of measured recordings, and a browser."""

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


@pytest.fixture(scope="session", autouse=True)
def _compile_without_a_notice():
    """Commands print the same whether this installation has compiled its loops already or not."""
    from driftlab.commands import console

    console.COMPILED = float("inf")


@pytest.fixture(scope="session")
def browser():
    """A browser without a window."""
    from browsers import started

    with started() as found:
        yield found


@pytest.fixture
def opened(browser):
    """A function that opens pages; at the end none may have complained, or asked for anything beyond this machine."""
    from browsers import Opened

    pages = Opened(browser)
    yield pages
    pages.close()
