"""Fixtures that all tests share: the folder of measured recordings, and a browser."""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# files that take longest, though most have few tests; the campaigns of bad input last minutes, wait for one another,
# and begin when the loops are compiled, which each of their processes would do by itself
LONG = (
    "test_explain.py", "test_docs.py", "test_torture.py", "test_ownership.py", "test_live.py", "test_shared_effects.py",
    "test_explain_files.py", "test_unit.py", "test_plugin_examples.py", "test_family_example.py", "test_live_waits.py",
    "test_plan.py", "test_examples.py", "test_live_web.py", "test_fleet_killed.py", "test_checkpoint.py",
    "test_pages_every_kind.py", "test_detectability.py", "test_navigator.py", "test_live_map.py", "test_compilation.py",
    "test_third_party.py",
)  # fmt: skip


def pytest_configure(config):
    """Leave the order to what follows: pytest-xdist would begin with the files that have most tests.

    Commands are interrupted by tests, also where the suite runs in the background and shells have Ctrl-C ignored.
    """
    config.option.loadscopereorder = False
    settings.register_profile("untimed", deadline=None)  # a slow hour fails no test
    settings.load_profile("untimed")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.set_threshold(100_000, 50, 50)  # as the command line has it; a quarter of the collection of tests went into this


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest, so that at the end no process waits for another that has one of them."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


def pytest_collection_finish():
    """Leave what imports have made out of later searches for garbage: all of it stays."""
    gc.collect()
    gc.freeze()


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
    from driftlab.commands import compilation

    compilation.COMPILED = float("inf")


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
