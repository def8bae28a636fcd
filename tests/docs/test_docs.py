"""Examples of the README and the docs are run and checked: a page's commands in one folder, and its configs.

A block after `<!-- not run: WHY -->` is left out. A config is called as its first line says (`# twin.yaml`), or by the
last name that is mentioned before it; recordings that a page does not make are small ones made here.
"""

import json
import re
import shlex
import subprocess
import sys
import time
from contextlib import ExitStack, chdir, contextmanager
from pathlib import Path
from typing import Literal

import h5py
import jsonschema
import numpy as np
import planted
import pytest
import turned_units
from command_line import driftlab
from other_formats import write_formats
from typer.testing import CliRunner
from units_at_rest import unit_at_rest
from yaml12 import read

from driftlab.cli import app
from fusion_core import contracts

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.parent.name != "adr")]
RAISES = {"errors.md"}  # what it shows must fail: tests of their own
ELSEWHERE = [["plugins", "--check"]]  # half a minute, as `tests/test_plugin_examples.py` runs it
PRINTED = {"first_run", "plan_a_soak", "put_a_map_into_your_firmware"}  # recordings of their own: in full or shortened
TYPED = ("driftlab", "$", "...", "python", ".venv/", "source .venv", "arm-none-eabi-gcc")
UNDER = {  # where a piece of a config belongs that does not begin at its top
    "calibration": ("filter", "gyro"),
    "bias": ("filter", "gyro"),
    "framing": ("source",),
    "valid": ("source", "channels"),
}
RECORDINGS = {  # seconds, rate, and temperature over time
    "soak.h5": (3600, 10, lambda t: 5 + t / 90),
    "run.h5": (300, 10, lambda t: 20 + t / 100),
    "day1.h5": (3000, 2, lambda t: 5 + t / 75),
    "day2.h5": (3000, 2, lambda t: 45 - t / 75),
    "rest.h5": (600, 20, lambda t: 20 + 0 * t),
    "day.h5": (96_000, 1, lambda t: 25 + 5 * np.sin(t / 9000)),
}
LIKE = {"ramp.h5": "run.h5", "recording.h5": "run.h5"}


def blocks(page):
    """Yield kind (yaml, python, shell), text, and the text before each block of a page that is run or checked."""
    text = page.read_text(encoding="utf-8")
    pattern = r"^```(\w*)\n(.*?)^```$|((?:^    [^\n]*\n(?:\n(?=    ))?)+)"
    end = 0
    for found in re.finditer(pattern, text, re.MULTILINE | re.DOTALL):
        before, end = text[end : found.start()].rstrip(), found.end()
        if re.search(r"<!-- not run: [^>]+ -->$", before):
            continue
        kind = {"console": "shell", "bash": "shell"}.get(found[1] or "", found[1] or "shell")
        yield kind, found[2] or found[3], before


def commands(text):
    """Return the commands of a block, without what the program answered."""
    joined = re.sub(r"\\\n\s*", " ", text)
    lines = [line.strip().removeprefix("$ ") for line in joined.splitlines()]
    words = [shlex.split(line, comments=True)[1:] for line in lines if re.match(r"driftlab [a-z-]+( |$)", line)]
    return [line[: line.index(">")] if ">" in line else line for line in words]


@contextmanager
def in_background(folder, *args):
    """Run a command of a page that ends in `&`, until the end of the page; what it is to make is there."""
    process = subprocess.Popen([sys.executable, "-m", "driftlab", *args], cwd=folder, stdout=subprocess.DEVNULL)
    try:
        out = folder / args[args.index("--out") + 1]
        while not out.exists():
            assert process.poll() is None, f"driftlab {shlex.join(args)}: ended with {process.returncode}"
            time.sleep(0.01)
        yield
    finally:
        process.terminate()
        process.wait()


def name_of(text, before):
    """Return what a config is called, None where the page does not say, or shows a piece of it."""
    first = re.match(r"# (\S+\.yaml)\b", text)
    mentioned = re.findall(r"`(\w+\.yaml)`", before.rpartition("\n\n")[2])
    if not {"extends", "source"} & read(text).keys():
        return None
    return first[1] if first else mentioned[-1] if mentioned and "extends" in read(text) else None


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with the README's config, recordings, and a map."""
    folder = tmp_path_factory.mktemp("bench")
    for name, (seconds, rate, temperature) in RECORDINGS.items():
        unit = unit_at_rest(seconds=seconds, rate=rate, temperature=temperature, walk=1e-8)
        with h5py.File(folder / name, "w") as file:
            for column, values, label in (
                ("time", unit.t - unit.t[0], "s"), ("gyro", np.rad2deg(unit.gyro), "deg/s"),
                ("accel", unit.accel / 9.80665, "g"), ("temperature", unit.temperature, "degC"),
            ):  # fmt: skip
                file[column] = values
                file[column].attrs["unit"] = label
        if name == "run.h5":
            write_formats(folder, unit)
    for name, other in LIKE.items():
        (folder / name).symlink_to(other)
    config = next(text for _, text, _ in blocks(ROOT / "README.md") if text.startswith("# unit.yaml"))
    (folder / "unit.yaml").write_text(config)
    run_in(folder, "fit-map", "unit.yaml", "--input", "soak.h5")
    return folder


def run_in(folder, *args):
    done = driftlab(*args, cwd=folder)
    assert done.returncode == 0, f"driftlab {shlex.join(args)}: {done.stderr}"
    return done.stdout


def words_of(text):
    """Return a text without the frames of tables and the breaks of lines."""
    return " ".join(re.sub("[━─┏┓┗┛┃┳┻╇┡┩│├┤┼└┘┴]", " ", text).split())


def with_commands():
    for page in PAGES:
        if page.name not in RAISES and any(commands(text) for kind, text, _ in blocks(page) if kind == "shell"):
            yield page


@pytest.mark.parametrize("page", list(with_commands()), ids=lambda page: page.stem)
def test_what_a_page_tells_to_do_works(page, bench, tmp_path):
    for path in bench.iterdir():
        if path.is_file():
            (tmp_path / path.name).symlink_to(path.resolve())
    if page.stem == "calibrate_a_production_line":
        planted.make(tmp_path, count=14, hours=0.25, fresh=2, later=3)
    if page.stem == "calibrate_scale_and_misalignment":
        t, y, T, table = turned_units.turntable(0, [-20.0, 20.0, 60.0], hold=8.0)
        rows = np.column_stack([t, np.rad2deg(y), T])
        np.savetxt(tmp_path / "turned.csv", rows, delimiter=",", header="t,gx,gy,gz,T", comments="", fmt="%.9g")
        (tmp_path / "table.csv").write_text(table)
    with ExitStack() as running:
        follow(page, tmp_path, running)


def follow(page, tmp_path, running):
    printed = ""
    for kind, text, before in blocks(page):
        if kind == "yaml" and (name := name_of(text, before)) and read(text).keys() <= TOP:
            (tmp_path / name).unlink(missing_ok=True)
            (tmp_path / name).write_text(text)
        elif kind == "python" and "Save this as" in before:
            for made in re.findall(r'record\("(\S+?)"', text):
                (tmp_path / made).unlink(missing_ok=True)
            with chdir(tmp_path):
                exec(compile(text, page.name, "exec"), {})
        elif kind == "python" and page.name == "README.md":
            with chdir(tmp_path):
                exec(compile(text, page.name, "exec"), {**vars(contracts), "np": np, "Literal": Literal})
        elif kind == "shell":
            for command in commands(text):
                if command[0] == "simulate" and (made := tmp_path / command[command.index("--out") + 1]).is_symlink():
                    made.unlink()  # the page makes a recording of its own
                if command[-1] == "&":
                    running.enter_context(in_background(tmp_path, *command[:-1]))
                elif command not in ELSEWHERE:
                    printed += words_of(run_in(tmp_path, *command)) + " "
            if page.stem in PRINTED:
                for line in text.splitlines():
                    assert line.strip().startswith(TYPED) or words_of(line) in printed


TOP = {"extends", "serial", "latitude", "heading", "source", "filter", "stimulus", "limits", "certificate"}


@pytest.fixture(scope="module")
def validator():
    done = CliRunner().invoke(app, ["schema"])
    return jsonschema.Draft202012Validator(json.loads(done.stdout))


def configs():
    for page in PAGES:
        for k, (kind, text, _) in enumerate(blocks(page)):
            if kind == "yaml":
                yield pytest.param(text, id=f"{page.stem}-{k}")


@pytest.mark.parametrize("text", list(configs()))
def test_every_config_that_a_page_shows_is_one(text, validator):
    content = read(text)
    for key in set(content) - TOP:
        content = {**{k: v for k, v in content.items() if k != key}, **nested(UNDER[key], {key: content[key]})}
    validator.validate({"extends": "mems_crs05", **content})


def nested(keys, value):
    for key in reversed(keys):
        value = {key: value}
    return value
