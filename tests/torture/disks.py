"""Full disks, places that cannot be written, two commands in one place: no traceback, and nothing is lost.

A disk that is full is a tmpfs of a few kilobytes where the harness is root, and RLIMIT_FSIZE in any case.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from bench import Device, paced, unit_frames

from torture import base
from torture.commands import TIMEOUT, begin, call, ended, kill
from torture.kills import ESTIMATES, RAW, begins_with, count, live_config, rows
from torture.outcome import Outcome, Said

CASES, WORKERS, LIMIT, IN_PROCESS = 80, 4, 45.0, False
RNG = np.random.Generator
Scenario = Callable[["Bench", RNG, Path], Outcome]
POLYNOMIAL = {"kind": "polynomial", "order": 2, "min_swing": "0.5 K"}


def prepare(folder: Path) -> None:
    """Write a recording, and configs of every command."""
    base.write_h5(folder / "recording.h5", base.recording(300, 100))
    source = base.source("hdf5", path=str(folder / "recording.h5"))
    base.write_config(folder / "run.yaml", base.config(source))
    base.write_config(folder / "other.yaml", base.config(source, {"kind": "constant"}))
    base.write_config(
        folder / "map.yaml", base.config(source, {"kind": "thermal_derivative", "walk": base.WALK, "map": POLYNOMIAL})
    )
    base.write_config(folder / "twin.yaml", {"source": {"kind": "synthetic", "duration": "5 min", "interval": "10 ms"}})


@contextmanager
def disk(place: Path, size: int | str = "1m") -> Iterator[bool]:
    """Mount a small disk; False where the harness may not."""
    place.mkdir(parents=True, exist_ok=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "torture", place], capture_output=True, check=False
    )
    try:
        yield mounted.returncode == 0
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", "-l", place], check=False, capture_output=True)


def content(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and not p.is_symlink()
    }


def judged(said: Said | Outcome, out: Path | None = None) -> Outcome:
    """Return the outcome of a command; where it ended with 0, its results must be whole."""
    refused = said if isinstance(said, Outcome) else said.refused()
    if refused is not None:
        return refused
    if out is not None and out.is_dir():
        try:
            json.loads((out / "summary.json").read_text())
            with h5py.File(out / "estimates.h5") as file:
                assert len({len(data) for data in file.values()}) == 1, "columns differ in length"
        except Exception as error:  # whatever a file that is not whole makes of it
            return Outcome("nonsense", "exit status 0, and the results are not whole", repr(error))
    return Outcome("accepted")


class Bench:
    """The files of an undisturbed run, and the time that a slow one takes."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        since = time.monotonic()
        said = ended(begin(folder, "run", "run.yaml", "--out", case / "out", slowly=True))
        self.seconds = time.monotonic() - since
        outcome = judged(said, case / "out")
        self.reference = rows(case / "out" / "estimates.h5", ESTIMATES)
        if outcome.kind != "accepted" or self.reference is None:
            raise RuntimeError(f"the undisturbed run: {outcome}")
        self.earlier = folder / f"earlier-{os.getpid()}"
        shutil.copytree(case / "out", self.earlier)

    def config(self, name: str) -> Path:
        """Return the path of a config."""
        return self.folder / f"{name}.yaml"

    def command(self, out: Path, rng: RNG) -> list[Any]:
        """Return a command that writes."""
        return [
            ["run", self.config("run"), "--out", out / "out"],
            ["run", self.config("run"), "--out", out / "out"],
            ["allan", self.config("run"), "--out", out / "allan"],
            ["simulate", self.config("twin"), "--out", out / "twin.h5"],
            ["simulate", self.config("twin"), "--out", out / "twin.csv"],
            ["fit-map", self.config("map"), "--out", out / "map.json"],
            ["compare", self.config("run"), self.config("other"), "--out", out / "compared"],
        ][rng.integers(7)]

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """One of the scenarios, in turn."""
        return SCENARIOS[number % len(SCENARIOS)](self, rng, folder)


def small_disk(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A disk that is full sooner or later, with earlier results on it where they fit."""
    place, size = folder / "disk", int(10 ** rng.uniform(3.7, 6.6))
    with disk(place, size) as mounted:
        if not mounted:
            return limited(bench, rng, folder)
        before = {}
        if rng.random() < 0.5 and size > 2 * sum(map(len, content(bench.earlier).values())):
            shutil.copytree(bench.earlier, place / "out")
            before = content(place / "out")
        args = bench.command(place, rng)
        outcome = judged(call(folder, *args), place / "out" if args[0] == "run" else None)
        if outcome.kind == "clean" and before and content(place / "out") != before:
            return Outcome("lost", "earlier results, after a full disk", outcome.detail)
        return outcome


def limited(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """Files that cannot grow beyond a size."""
    args = bench.command(folder, rng)
    said = call(folder, *args, largest=int(10 ** rng.uniform(2, 6.5)))
    return judged(said, folder / "out" if args[0] == "run" else None)


def read_only(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A place that cannot be written, with earlier results in it."""
    place = folder / "disk"
    with disk(place, "20m") as mounted:
        if mounted:
            shutil.copytree(bench.earlier, place / "out")
            subprocess.run(["mount", "-o", "remount,ro", place], check=True, capture_output=True)
        target = place if mounted else Path("/proc")
        outcome = judged(call(folder, *bench.command(target, rng)))
        if mounted and content(place / "out") != content(bench.earlier):
            return Outcome("lost", "earlier results, in a place that cannot be written")
        return (
            Outcome("nonsense", "a place that cannot be written was written") if outcome.kind == "accepted" else outcome
        )


def two_at_once(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A second command on the folder of one that runs: it ends with an error, and the first with its results."""
    first = begin(folder, "run", bench.config("run"), "--out", "out", slowly=True)
    deadline = time.monotonic() + TIMEOUT
    while not (folder / "out.partial").exists() and first.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(rng.uniform(0, 0.3))
    more = [["--resume"], [], ["--force"]][rng.integers(2)]
    second = judged(call(folder, "run", bench.config("run"), "--out", "out", *more))
    alive = first.poll() is None
    outcome = judged(ended(first), folder / "out")
    found = rows(folder / "out" / "estimates.h5", ESTIMATES) if (folder / "out").exists() else None
    if outcome.kind != "accepted" or found is None or bench.reference is None or count(found) != count(bench.reference):
        return Outcome("lost", "results of the first of two commands in one folder", f"{outcome}\n{second}")
    if second.kind == "accepted" and alive:
        return Outcome("lost", "a second command replaced the folder of one that runs")
    return second


def foreign_partial(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A folder that happens to have the temporary name."""
    name = ["out.partial", "out"][rng.integers(2)]
    (folder / name).mkdir()
    (folder / name / "mine.txt").write_text("mine")
    outcome = judged(call(folder, "run", bench.config("run"), "--out", "out"))
    if not any(path.read_text() == "mine" for path in folder.rglob("mine.txt")):
        return Outcome("lost", f"somebody's own file in {name}")
    return outcome


def not_twice(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A `live` that was killed, begun again without --resume: what it had estimated and recorded is kept."""
    device, stop = Device(folder), threading.Event()
    try:
        live_config(folder, device)
        sender = paced(device, unit_frames(60, 200), 200, stop)
        process = begin(folder, "live", "live.yaml", "--record", "raw.h5", "--out", "out", "--json")
        time.sleep(rng.uniform(5, 8))
        kill(process)
        before = next((found for path in folder.glob("out*/estimates.h5") if (found := rows(path, ESTIMATES))), {})
        raw = rows(folder / "raw.h5", RAW) if (folder / "raw.h5").exists() else None
        record = ["--record", ["raw.h5", "raw2.h5"][rng.integers(2)]] if rng.random() < 0.7 else []
        outcome = judged(call(folder, "live", "live.yaml", "--out", "out", "--duration", "1 s", *record))
    finally:
        stop.set()
        sender.join()
        device.close()
    left = [found for path in folder.rglob("estimates.h5") if (found := rows(path, ESTIMATES)) is not None]
    if count(before) and not any(
        count(one) >= count(before) and begins_with(one, before, count(before)) for one in left
    ):
        return Outcome("lost", "estimates of a live run that was killed", outcome.detail)
    if raw and count(rows(folder / "raw.h5", RAW)) < count(raw):
        return Outcome("lost", "the recording of a live run that was killed")
    return outcome


def own_input(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """An output that is the command's own input, or somebody's file."""
    for name in ("recording.h5", "map.yaml"):
        shutil.copy(bench.folder / name, folder / name)
    (folder / "notes.txt").write_text("mine")
    before = content(folder)
    target = ["recording.h5", "map.yaml", "notes.txt"][rng.integers(3)]
    args = [
        ["fit-map", "map.yaml", "--input", "recording.h5", "--out", target],
        ["simulate", bench.config("twin"), "--out", target],
        ["run", "map.yaml", "--input", "recording.h5", "--out", target],
    ][rng.integers(3)]  # fmt: skip
    outcome = judged(call(folder, *args))
    after = content(folder)
    if any(after.get(name) != data for name, data in before.items()):
        return Outcome("lost", f"{args[0]} --out {target} replaced it", outcome.detail)
    return outcome


def odd_places(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """Links, mount points, devices, long and odd names: whole results or a clean error."""
    (folder / "real").mkdir()
    (folder / "link").symlink_to("real")
    (folder / "loop").symlink_to("loop")
    (folder / "nowhere").symlink_to("gone/away")
    names = [
        "link",
        "loop",
        "nowhere",
        "o[final]",
        "o[/]",
        "a/b/c",
        "/dev/null",
        "/dev/full",
        ".",
        "..",
        "",
        "x" * 300,
        "é ü",
        "new\nline",
        "-x",
        "o.partial",
    ]
    name = [*names, "disk"][rng.integers(len(names) + 1)]
    if name != "disk":
        inside = folder / "inside"
        inside.mkdir()
        for link in ("real", "link", "loop", "nowhere"):
            (folder / link).rename(inside / link)
        return judged(
            call(inside, "run", bench.config("run"), f"--out={name}"), inside / name if len(name) < 200 else None
        )
    with disk(folder / "disk", "50m"):
        return judged(call(folder, "run", bench.config("run"), "--out", "disk"), folder / "disk")


def no_speech(bench: Bench, rng: RNG, folder: Path) -> Outcome:
    """A device that is silent, or speaks at another rate of bits: `--duration` ends it."""
    device, stop = Device(folder), threading.Event()
    try:
        live_config(folder, device)
        noise = [bytes(rng.integers(0, 256, 40, dtype=np.uint8)) for _ in range(4000)] if rng.random() < 0.5 else []
        sender = paced(device, noise, 200, stop)
        return judged(call(folder, "live", "live.yaml", "--out", "out", "--duration", "2 s"))
    finally:
        stop.set()
        sender.join()
        device.close()


SCENARIOS: tuple[Scenario, ...] = (
    small_disk, limited, two_at_once, foreign_partial, not_twice, own_input, odd_places, no_speech, small_disk,
    read_only,
)  # fmt: skip
