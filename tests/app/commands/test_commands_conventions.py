"""Conventions that every user expects of a command line."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from driftlab import __version__
from driftlab.cli import app
from fusion_core.contracts import Exporter, ThermalMap
from fusion_core.errors import ConfigError
from fusion_core.host.registry import registry

DRIFTLAB = Path(sys.executable).with_name("driftlab")
PROGRAM = [sys.executable, "-m", "driftlab"]
WITH_CONFIG = ("run", "fit-map", "allan", "compare", "explain", "plan", "simulate", "live", "check")
COMMANDS = (*WITH_CONFIG, "init", "export", "import", "vehicle", "plugins", "schema")
CONFIG = """
extends: mems_crs05
source: {kind: synthetic, duration: 2 min, rate: 20 Hz}
filter: {accel: null, align: 20 s, gyro: {bias: {kind: random_walk, walk: 1e-5 deg/s/sqrt(s)}}}
"""


def driftlab(*args):
    return CliRunner().invoke(app, [str(arg) for arg in args])


@pytest.fixture
def unit(tmp_path):
    path = tmp_path / "unit.yaml"
    path.write_text(CONFIG)
    return path


def test_it_says_its_version():
    assert driftlab("--version").stdout == f"driftlab {__version__}\n"


@pytest.mark.parametrize("command", [(), *((name,) for name in COMMANDS)])
def test_h_is_help(command):
    short, long = driftlab(*command, "-h"), driftlab(*command, "--help")
    assert short.exit_code == 0
    assert short.stdout == long.stdout
    assert "Usage: " in short.stdout


def test_the_list_of_commands_cuts_no_sentence():
    listed = driftlab("--help").stdout.partition("Commands:")[2]
    assert "export" in listed
    assert "..." not in listed


def test_the_help_of_export_and_import_names_every_form_that_comes_with_it():
    forms = {kind: cls for kind, cls in registry().classes(Exporter).items() if cls.__module__.startswith("fusion_")}
    told = driftlab("export", "--help").stdout
    assert {kind for kind in forms if not re.search(rf"^ +{kind} ", told, re.MULTILINE)} == set()
    told = driftlab("import", "--help").stdout
    for kind, cls in forms.items():
        assert bool(re.search(rf"^ +{kind} ", told, re.MULTILINE)) == (cls.read is not Exporter.read)


def test_the_package_is_a_program():
    done = subprocess.run([*PROGRAM, "--version"], capture_output=True, text=True, timeout=60)
    assert done.stdout == f"driftlab {__version__}\n"


@pytest.mark.parametrize(
    ("shell", "asked"),
    [
        ("bash", {"COMP_WORDS": "driftlab fi", "COMP_CWORD": "1"}),
        ("zsh", {"_TYPER_COMPLETE_ARGS": "driftlab fi"}),
        ("fish", {"_TYPER_COMPLETE_ARGS": "driftlab fi", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}),
    ],
)
def test_a_shell_that_asks_gets_completions(shell, asked):
    environment = os.environ | asked | {"_DRIFTLAB_COMPLETE": f"complete_{shell}"}
    done = subprocess.run([DRIFTLAB], env=environment, capture_output=True, text=True, timeout=60)
    assert "fit-map" in done.stdout
    assert "compare" not in done.stdout


def test_options_are_completed():
    asked = {"_DRIFTLAB_COMPLETE": "complete_bash", "COMP_WORDS": "driftlab run --in", "COMP_CWORD": "2"}
    done = subprocess.run([DRIFTLAB], env=os.environ | asked, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["--input"]


def test_completion_installs_itself(tmp_path):
    # the shell is named: which one the test was started from does not matter
    environment = os.environ | {"HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run(
        [DRIFTLAB, "--install-completion", "bash"], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    written = "".join(path.read_text() for path in tmp_path.rglob("*") if path.is_file())
    assert "_DRIFTLAB_COMPLETE=complete_bash" in written


def on_a_terminal(*program, **environment):
    """Run the program on a terminal, and return what it wrote there."""
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    ours, theirs = os.openpty()
    env = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    env |= {"TERM": "xterm-256color", "COLUMNS": "100", **environment}
    running = subprocess.Popen(program, stdout=theirs, stderr=theirs, stdin=theirs, env=env)
    os.close(theirs)
    parts = []
    try:
        while part := os.read(ours, 4096):
            parts.append(part)
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    assert running.wait(timeout=60) == 0
    return b"".join(parts).decode()


def test_no_color_is_obeyed():
    colour = re.compile(r"\x1b\[[0-9;]*(3[0-7]|9[0-7]|38;5;\d+)m")
    red = "from driftlab.commands.console import terminal; terminal().print('text', style='red')"
    assert colour.search(on_a_terminal(sys.executable, "-c", red))
    assert not colour.search(on_a_terminal(sys.executable, "-c", red, NO_COLOR="1"))


@pytest.mark.parametrize("command", COMMANDS)
def test_how_much_is_said_can_be_chosen_of_every_command(command):
    taken = {
        option for parameter in get_command(app).commands[command].command.made().params for option in parameter.opts
    }
    assert {"-q", "--quiet", "-v", "--verbose"} <= taken
    assert ("--set" in taken) == (command in (*WITH_CONFIG, "export", "import", "vehicle"))


def test_an_export_can_be_quiet_and_keeps_its_own_set(tmp_path):
    line = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})
    at = tmp_path / "m.json"
    T = np.linspace(0, 50, 2000)
    line.fit(T, 1e-6 * T[:, None] * [1, 2, 3], {}).save(at)
    loud = driftlab("export", "csv_table", at, "--out", tmp_path / "loud.csv", "--set", "step=10 K")
    quiet = driftlab("export", "csv_table", at, "--out", tmp_path / "quiet.csv", "--set", "step=10 K", "-q", "-v")
    assert "deg/h rms" in loud.stdout
    assert (quiet.exit_code, quiet.stdout) == (0, "")
    assert "in all" in quiet.stderr
    assert (tmp_path / "quiet.csv").read_bytes() == (tmp_path / "loud.csv").read_bytes()
    assert driftlab("plugins", "-q").output == ""


def test_quiet_says_nothing_and_does_the_same(unit, tmp_path):
    loud = driftlab("run", unit, "--out", tmp_path / "loud")
    quiet = driftlab("run", unit, "--out", tmp_path / "quiet", "-q")
    assert loud.exit_code == quiet.exit_code == 0, quiet.output
    assert "written to" in loud.stdout
    assert quiet.output == ""
    assert [(tmp_path / name / "summary.json").read_bytes() for name in ("loud", "quiet")].count(
        (tmp_path / "loud" / "summary.json").read_bytes()
    ) == 2
    asked = driftlab("run", unit, "--out", tmp_path / "quiet", "--quiet", "--json")
    assert json.loads(asked.stdout)["schema"] == 1
    assert driftlab("check", unit, "-q").output == ""
    assert isinstance(driftlab("check", unit, "-q", "--set", "latitude=5").exception, ConfigError)


def test_verbose_says_what_took_how_long_and_which_plugins_ran(unit, tmp_path):
    done = driftlab("run", unit, "--out", tmp_path / "out", "-v")
    lines = done.stderr.splitlines()
    took = {
        what.strip(): float(s)
        for what, s in (re.match(r"(.*?) +([\d.]+) s$", x).groups() for x in lines if x.endswith(" s"))
    }
    assert {"reading unit.yaml", "filtering", "in all"} <= set(took)
    assert sum(took.values()) - took["in all"] <= took["in all"] + 0.01 * len(took)
    assert {f"plugin: {p} (driftlab {__version__})" for p in ("sources synthetic", "bias_models random_walk")} <= set(
        lines
    )
    assert "plugin:" not in done.stdout, "standard output is as without"


@pytest.mark.parametrize("command", ["run", "check", "allan"])
def test_a_second_recording_is_not_taken_in_silence(unit, command):
    done = driftlab(command, unit, "--input", "a.h5", "--input", "b.h5")
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception) == "--input: is given 2 times, one recording was expected; run one at a time"


class TestSet:
    def understood(self, unit, *settings):
        done = driftlab("check", unit, "--json", *(x for s in settings for x in ("--set", s)))
        assert done.exit_code == 0, done.exception
        return json.loads(done.stdout)

    def refused(self, unit, *settings):
        done = driftlab("check", unit, *(x for s in settings for x in ("--set", s)))
        assert isinstance(done.exception, ConfigError)
        return str(done.exception)

    def test_keys_of_the_file_of_the_product_and_new_ones(self, unit):
        found = self.understood(
            unit,
            "filter.align=30 s",
            "filter.gyro.noise=1 deg/h/sqrt(Hz)",
            "latitude=40.9 deg",
            "filter.rest.false_alarm=1e-5",
        )
        assert found["filter"]["align"] == "30 s"
        assert found["filter"]["gyro"]["noise"] == "1 deg/h/sqrt(Hz)"
        assert found["filter"]["rest"]["false_alarm"] == 1e-5
        assert found["latitude"] == "40.9 deg"
        assert found["filter"]["gyro"]["bias"]["walk"] == "1e-5 deg/s/sqrt(s)", "what is not set stays"

    def test_another_kind_takes_the_place_of_the_mapping_and_the_last_wins(self, unit):
        found = self.understood(
            unit, "filter.gyro.bias.kind=gauss_markov", "filter.gyro.bias.sigma=1 deg/h", "filter.gyro.bias.tau=1 h",
            "filter.gyro.bias.tau=2 h",
        )  # fmt: skip
        assert found["filter"]["gyro"]["bias"]["kind"] == "gauss_markov"
        assert found["filter"]["gyro"]["bias"]["tau"] == "2 h"
        assert "walk" not in found["filter"]["gyro"]["bias"]

    def test_a_mapping_and_null_are_yaml(self, unit):
        found = self.understood(unit, "filter.gyro.bias={kind: constant}", "filter.gyro.range=null")
        assert found["filter"]["gyro"]["bias"]["kind"] == "constant"
        assert "range" not in found["filter"]["gyro"]

    @pytest.mark.parametrize(
        ("setting", "message"),
        [
            ("filter.algn=30 s", "--set filter.algn=30 s: filter.algn: unknown key; did you mean 'align'?"),
            ("filter.align=30", "--set filter.align=30: filter.align: "),
            ("filter.align", "--set filter.align: is not KEY=VALUE; write e.g. --set 'filter.align=30 s'"),
            ("filter..align=1 s", "is not KEY=VALUE"),
            ("filter.align=", "--set filter.align=: holds no value; write one, null to leave the key out"),
            ("filter.align=[1", "--set filter.align=[1:1: is not YAML"),
            ("filter.align.x=1", "--set filter.align.x=1: filter.align is a value and has no keys; set all of it"),
            ("filter.gyro.bias.kind=constnt", "kind 'constnt' is not installed; did you mean constant?"),
            ("filter.gyro.bias.kind=gauss_markov", "filter.gyro.bias.sigma: is required and missing; add it"),
        ],
    )
    def test_what_is_wrong_is_named_by_what_was_written(self, unit, setting, message):
        assert message in self.refused(unit, setting)
        assert self.refused(unit, setting).startswith("--set ")

    @pytest.mark.parametrize("command", WITH_CONFIG)
    def test_every_command_that_takes_a_config_takes_it(self, unit, command):
        options = {
            "explain": ["--calibration", "a", "--train", "a", "--holdout", "b", "--out", "o"],
            "simulate": ["--out", "x.h5"],
        }
        done = driftlab(command, unit, *options.get(command, []), "--set", "latitud=1 deg")
        assert "--set latitud=1 deg: latitud: unknown key; did you mean 'latitude'?" in str(done.exception)

    def test_results_say_what_they_were_made_with(self, unit, tmp_path):
        import h5py

        assert driftlab("run", unit, "--out", tmp_path / "out", "--set", "filter.align=30 s").exit_code == 0
        with h5py.File(tmp_path / "out" / "estimates.h5") as file:
            assert "align: 30 s" in file.attrs["config"]
