"""Commands in surroundings that nobody meant for them: environments, closed streams, names, limits of the process.

Whatever surrounds a command, it ends with its results and what it prints without, or with one message. Where standard
error is closed nothing can be said, and the exit status alone counts.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torture import base
from torture.commands import MAIN, ended
from torture.disks import content, disk
from torture.outcome import Outcome, Said

CASES, WORKERS, LIMIT, IN_PROCESS = 160, 2, 305.0, False
RNG = np.random.Generator
POLYNOMIAL = {"kind": "polynomial", "order": 2, "min_swing": "0.5 K"}
PATIENCE = 300.0  # s by the clock, of a machine with other work: for another processor all is compiled anew, and said
LONG = "n" * 300
BAD_NAMES = ["", ".", "..", "/", "/dev/null", "/dev/full", LONG, "mine.txt/x", "circle", "circle/x", "dangling", "~x",
             "a\nb", "a\x1b[31mb", "a\u2028b", "a'\"b", "-x", "x" * 200 + "/" + "y" * 200, "/proc/self/mem", "pipe",
             "sub", "%s%n", "{0}", "a:b", " ", "\u202eb.json", "/nonexistent/x/y"]  # fmt: skip
VALUES = {
    "COLUMNS": ["0", "1", "-5", "x", "", "999999999"], "LINES": ["0", "x"], "TERM": ["", "dumb", "\x1b", "xterm"],
    "HOME": [None, "", "/nonexistent", "/dev/null"], "TMPDIR": ["/nonexistent", "/dev/null", "", "mine.txt"],
    "LANG": ["C", "xx_YY.zz", ""], "LC_ALL": ["C", "POSIX", "tr_TR.UTF-8"],
    "PYTHONIOENCODING": ["ascii", "latin-1", "cp437"], "PYTHONUTF8": ["0"], "TZ": ["nonsense", "", ":/dev/null"],
    "NUMBA_NUM_THREADS": ["0", "-1", "x", "", "100000"], "OPENBLAS_NUM_THREADS": ["0", "x", "-1"],
    "OMP_NUM_THREADS": ["0", "x"], "POLARS_MAX_THREADS": ["0", "x", "-1"], "NUMBA_CACHE_DIR": ["/nonexistent", "/proc"],
    "MPLBACKEND": ["nonsense", ""], "MPLCONFIGDIR": ["/proc/x", "mine.txt"], "XDG_CACHE_HOME": ["/proc/x", "mine.txt"],
    "DRIFTLAB_DEBUG": ["", "x", "0"], "SOURCE_DATE_EPOCH": ["x", "-1", "99999999999999"], "NO_COLOR": ["1"],
    "FORCE_COLOR": ["1"], "NUMBA_DISABLE_JIT": ["x"], "NUMBA_CPU_NAME": ["nonsense"], "PWD": ["/nonexistent", ""],
}  # fmt: skip


@dataclass
class Surroundings:
    """The surroundings that a process is begun with."""

    what: str
    env: dict[str, str] = field(default_factory=lambda: dict(os.environ))
    closed: tuple[int, ...] = ()
    streams: dict[str, Any] = field(default_factory=dict)
    before: Callable[[], None] | None = None
    mute: bool = False  # whether nothing it says can be heard


def prepare(folder: Path) -> None:
    """Write a recording, a map and configs of every command."""
    base.write_h5(folder / "recording.h5", base.recording(180, 10))
    base.fit_map(folder / "polynomial.json", kind="polynomial", order=3)
    source = base.source("hdf5", path=str(folder / "recording.h5"))
    base.write_config(folder / "run.yaml", base.config(source))
    base.write_config(folder / "other.yaml", base.config(source, {"kind": "constant"}))
    base.write_config(
        folder / "map.yaml", base.config(source, {"kind": "thermal_derivative", "walk": base.WALK, "map": POLYNOMIAL})
    )
    used = {"kind": "polynomial", "path": str(folder / "polynomial.json")}
    base.write_config(folder / "mapped.yaml", base.config(source, calibration=used))
    base.write_config(folder / "twin.yaml", {"source": {"kind": "synthetic", "duration": "1 min", "rate": "10 Hz"}})
    (folder / "units.csv").write_text(f"unit,recording\none,{folder / 'recording.h5'}\n")


def commands(folder: Path) -> list[list[str]]:
    """Return the commands, each with a name that it reads and one that it writes where it has them."""
    given = {name: str(folder / f"{name}.yaml") for name in ("run", "other", "map", "mapped", "twin")}
    recording = str(folder / "recording.h5")
    return [
        ["run", given["run"], "--out", "out"],
        ["run", given["run"], "--input", recording, "--out", "out"],
        ["fit-map", given["map"], "--out", "map.json"],
        ["fit-map", given["map"], "--out", "map.json", "--report", "pages"],
        ["allan", given["run"], "--out", "allan"],
        ["compare", given["run"], given["other"], "--out", "compared"],
        ["simulate", given["twin"], "--out", "twin.h5"],
        ["simulate", given["twin"], "--out", "twin.csv"],
        ["check", given["mapped"]],
        ["init", recording, "--out", "first.yaml"],
        ["export", "px4", given["mapped"], "--out", "parameters.params"],
        ["export", "csv_table", given["mapped"], "--out", "table.csv"],
        ["plan", given["map"], "--hours", "2", "--out", "plan"],
        ["fleet", given["map"], "--units", str(folder / "units.csv"), "--out", "fleet"],
        ["plugins"],
        ["schema"],
        ["--help"],
        ["run", "--help"],
        ["--version"],
    ]


class Bench:
    """The commands as they end where nothing is in their way."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """One command in one of the surroundings."""
        furnish(folder)
        mine = content(folder)
        all_of_them = commands(self.folder)
        args = list(all_of_them[rng.integers(len(all_of_them))])
        kind = KINDS[number % len(KINDS)]
        with disk(folder / "full", 4096) as mounted:
            around = kind(rng, args, folder, mounted)
            said = run(args, around, folder)
        shown = f"{around.what}, `{' '.join(args)[:200]}`"
        lost = [name for name, data in mine.items() if content(folder).get(name) != data]
        if lost:
            return Outcome("lost", f"{lost[0]} in {around.what.split(':')[0]}", shown)
        outcome = judged(said, around, args)
        return replace(outcome, detail=f"{shown}\n{outcome.detail}")


def furnish(folder: Path) -> None:
    """Make what the bad names mean."""
    (folder / "mine.txt").write_text("mine")
    (folder / "sub").mkdir()
    (folder / "sub" / "mine.csv").write_text("mine")
    (folder / "circle").symlink_to("circle")
    (folder / "dangling").symlink_to("nothing/here")
    os.mkfifo(folder / "pipe")


def run(args: list[str], around: Surroundings, folder: Path) -> Said | Outcome:
    """Run a command to its end."""

    def begin() -> None:
        if around.before is not None:
            around.before()
        for number in around.closed:
            os.close(number)

    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | around.streams
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, *args], cwd=folder, env=around.env, text=True, errors="replace",
        preexec_fn=begin, **streams,
    )  # fmt: skip
    return ended(process, PATIENCE)


def judged(said: Said | Outcome, around: Surroundings, args: list[str]) -> Outcome:
    """Return what a command came to."""
    if isinstance(said, Outcome):
        return said
    refused = said.refused()
    if refused is not None and refused.kind == "nonsense" and around.mute:
        return Outcome("clean")
    if refused is None and not said.out and not around.mute:
        return Outcome("nonsense", f"{args[0]}: exit status 0 and nothing printed")
    if refused is None and "Exception ignored" in said.err:
        return Outcome("traceback", "an exception at the end", said.err)
    return refused or Outcome("accepted")


def variables(rng: RNG, args: list[str], folder: Path, mounted: bool) -> Surroundings:
    """One to three variables of the environment."""
    env = dict(os.environ)
    names = rng.choice(sorted(VALUES), size=int(rng.integers(1, 4)), replace=False)
    said = []
    for name in names:
        value = VALUES[name][rng.integers(len(VALUES[name]))]
        said.append(f"{name}={value!r}")
        env.pop(name, None)
        if value is not None:
            env[name] = str(folder / value) if value == "mine.txt" else value
    return Surroundings(f"variables: {' '.join(said)}", env)


def nothing(rng: RNG, args: list[str], folder: Path, mounted: bool) -> Surroundings:
    """No environment at all but the path of modules."""
    return Surroundings("variables: none", {"PYTHONPATH": os.environ.get("PYTHONPATH", "")})


def streams(rng: RNG, args: list[str], folder: Path, mounted: bool) -> Surroundings:
    """Streams that are closed, full, or read by nobody."""
    kind = int(rng.integers(7))
    if kind < 4:
        closed = [(0,), (1,), (2,), (0, 1, 2)][kind]
        return Surroundings(f"streams: {closed} closed", closed=closed, mute=bool({1, 2} & set(closed)))
    if kind < 6:
        name = ("stdout", "stderr")[kind - 4]
        return Surroundings(f"streams: {name} full", streams={name: Path("/dev/full").open("w")}, mute=True)
    read, write = os.pipe()
    os.close(read)
    return Surroundings("streams: nobody reads stdout", streams={"stdout": write}, mute=True)


def places(rng: RNG, args: list[str], folder: Path, mounted: bool) -> Surroundings:
    """A bad name where it writes, or where it reads."""
    name = BAD_NAMES[rng.integers(len(BAD_NAMES))]
    name = str(folder / name) if name and name[0] != "/" and rng.random() < 0.3 else name
    spots = [k for k, arg in enumerate(args) if k > 0 and not arg.startswith("-") and args[0] not in ("--help",)]
    if not spots:
        return Surroundings("names: none")
    args[spots[rng.integers(len(spots))]] = name
    return Surroundings(f"names: {name[:40]!r}")


def limits(rng: RNG, args: list[str], folder: Path, mounted: bool) -> Surroundings:
    """A umask, few open files, a working directory that is gone, a disk that is full for temporary files."""
    kind = int(rng.integers(5))
    env = dict(os.environ)
    if kind == 0:
        mask = int(rng.choice([0o777, 0o000, 0o222]))
        return Surroundings(f"limits: umask {mask:03o}", before=lambda: os.umask(mask) and None)
    if kind == 1:
        most = int(rng.choice([8, 24, 64]))
        return Surroundings(
            f"limits: {most} files", before=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (most, most)),
            mute=most < 24,
        )  # fmt: skip
    if kind == 2:
        gone = folder / "gone"
        gone.mkdir()

        def leave() -> None:
            os.chdir(gone)
            gone.rmdir()

        return Surroundings("limits: no working directory", before=leave)
    if kind == 3 and mounted:
        (folder / "full" / "block").write_bytes(b"\0" * 4096)
        return Surroundings("limits: full TMPDIR", env | {"TMPDIR": str(folder / "full")})
    return Surroundings("limits: no core", before=lambda: resource.setrlimit(resource.RLIMIT_CORE, (0, 0)))


KINDS = (variables, places, streams, places, limits, variables, nothing)
