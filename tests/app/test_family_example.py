"""The example of a production line, in small: what is planted is found, and a family makes a short soak worth more."""

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest
from example_modules import importable

FOLDER = Path(__file__).parent.parent.parent / "examples" / "06_family"
PROOF = """
import json, planted, run
from rich.console import Console
if __name__ == "__main__":
    out = run.Path({out!r})
    line = planted.make(out / "line", 14, 1 / 3, fresh=4, later=6)
    found = run.prove(line, out, Console(stderr=True, width=200))
    print(json.dumps([sorted(found.odd), line.odd, {{k: v.tolist() for k, v in found.errors.items()}}, found.held]))
"""


@pytest.fixture(scope="module")
def proof(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    script = folder / "proof.py"  # a file: the pool's processes begin with it
    script.write_text(f"import sys\nsys.path.insert(0, {str(FOLDER)!r})\n" + PROOF.format(out=str(folder / "out")))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return *json.loads(done.stdout.splitlines()[-1]), done.stderr


def test_a_short_soak_is_worth_more_under_the_family(proof):
    _, _, errors, held, _ = proof
    own, known = (sorted(errors[name])[1] for name in ("own short soak", "short soak and family"))
    assert known < 0.8 * own  # of 200 units and soaks of two hours a third
    assert held > 0.8


def test_odd_units_are_named_and_the_tables_say_so(proof):
    odd, planted, _, _, said = proof
    assert len(set(odd) & set(planted)) >= len(planted) - 1
    assert f"{len(set(odd) & set(planted))} of {len(planted)}" in said


def test_a_later_day_is_held_against_frozen_limits(proof):
    *_, said = proof
    assert "frozen limits (of 14 units" in said
    shown = said[said.rindex("a later day") :]
    assert "x shifted by 250 deg/h" in shown
    assert shown.count("nothing is said of it") <= 2  # of six units soaked for 20 minutes, against fourteen


def test_a_shifted_lot_that_is_named_is_shown_as_found():
    """A lot that is off is a sentence of the family, not of the line's level: the table finds either."""
    with importable(FOLDER):
        import family
        import planted
        import run
    from rich.console import Console

    line = planted.Line(family.deal(20, 1), [], [], "L07", 2.0, 0.8, Path())
    said = "Lot L07: x is off the other lots by 253 deg/h at 22 °C."
    found = run.Found({}, {"family": {"lines": [said], "line": []}}, {}, 1.0, {})
    console = Console(record=True, width=200, file=io.StringIO())
    console.print(run.of_the_line(line, found))
    shown = console.export_text()
    assert "off the other lots by 253 deg/h" in shown
    assert shown.count("nothing is said of it") == 1  # of the hysteresis
