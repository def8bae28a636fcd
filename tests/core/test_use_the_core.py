"""The page on using the filter alone: its code is that of the scripts, and the scripts run and do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
LIBRARY = ROOT / "examples" / "library"
PAGE = (ROOT / "docs" / "how-to" / "use_the_core.md").read_text()
LINES = {"tracker": 11, "vertical_filter": 7}


def own(script):
    """The lines that one writes oneself: the cell after the comment that says so."""
    return re.search(r"^# the \w+\n(.*?)\n\n# %%", script, re.DOTALL | re.MULTILINE)[1]


@pytest.mark.parametrize("name", LINES)
def test_the_code_of_the_page_is_that_of_the_script(name):
    code = own((LIBRARY / f"{name}.py").read_text())
    assert f"```python\n{code}\n```" in PAGE
    assert len(code.splitlines()) == LINES[name]
    assert f"examples/library/{name}.py) ({LINES[name]} lines)" in PAGE.replace("\n", " ")
    assert PAGE.count("```python") == len(LINES)


def printed(name):
    done = subprocess.run([sys.executable, LIBRARY / f"{name}.py"], capture_output=True, text=True, check=True)
    return [[float(v) for v in re.findall(r"(?<![\^\w.])\d+\.?\d*", line)] for line in done.stdout.splitlines()]


def test_the_tracker_is_better_than_its_fixes_and_refuses_those_that_are_wrong():
    (rms, sigma), (fixes, refused) = printed("tracker")
    assert rms < 2.3  # between the fixes too, a second apart, some missing
    assert 0.7 < rms / sigma < 1.3
    assert fixes > 80
    assert 3 <= refused <= 7  # of seven wrong ones, those that are not missing


def test_the_vertical_filter_knows_its_errors():
    for rms, sigma in (line[-2:] for line in printed("vertical_filter")):
        assert 0.5 < rms / sigma < 1.5
