"""Texts of strangers in every place that has a name, and what the program makes of them for others to read.

A name of a column or a file, a serial number, a text of a map goes to parameter files, YAML, C, MATLAB, CSV, pages,
JSON and the terminal. Each is read by a reader of its own (PyYAML, csv, gcc, SciPy, html.parser, json), and compared
with what a plain text in the same place gives: no line, key, cell, statement or element more; on the terminal nothing
but characters and line feeds.
"""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import subprocess
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unicodedata import category

import h5py
import numpy as np
import yaml
from scipy.io import loadmat

from torture import base
from torture.outcome import Outcome, Said, program

CASES, WORKERS, LIMIT, IN_PROCESS = 1200, 2, 20.0, True
RNG = np.random.Generator
PLAIN = "voltage"
TEXTS = [
    f"a{end}EVIL 1{end}# "
    for end in ("\n", "\r\n", "\r", "\x85", "\u2028", "\u2029", "\x0b", "\x0c", "\x1c", "\\\n", "??/\n", "\x00")
] + [
    "\x1b[2J\x1b]0;EVIL\x07", "\x9b31m", "\x08\x08\x08EVIL", "\x7f", "\u202eEVIL\u202c", "\u2066EVIL", "a\u200bb",
    "\ufeff", "\ud800", "\U000e0041", '"', "'", "a\" onload=\"EVIL()", "\\", "a\\", "*/ int EVIL; /*", "*??/", "?>",
    "]]>", "--> <!--", "</script><script>EVIL()</script>", "</title><img src=x onerror=EVIL()>", "{{ 7 * 7 }}",
    "${EVIL}", "$x^2$", "=cmd|' /C EVIL'!A1", "@SUM(1,1)", "+EVIL", "-EVIL", "a,=EVIL", "a;=EVIL", "a\t=EVIL",
    "\uff1dEVIL", "%EVIL", "%s%n", "#", "# EVIL", "EVIL: 1", "- EVIL", "&a", "*a",
    "!!python/object/apply:os.system [EVIL]", "? EVIL", "|", ">", "---", "...", "~", "null", "yes", "1e3", "{a: 1}",
    "[a]", " ", " a ", "a" * 5000, "\N{GRINNING FACE}", "\N{MICRO SIGN}", "end", "int", "driftlab", "../../EVIL",
    "/etc/EVIL", "[red]a[/red]", ":smile:", "a::1:2",
]  # fmt: skip
BROKEN = re.compile(r"[\n\r\x0b\x0c\x1c\x85\u2028\u2029]EVIL")  # what begins with it was a part of a line
MAP = ("channel", "kind", "unit", "axis", "provenance", "provenance key", "device_id", "memory")
EXPORTS = {"px4": ".params", "ardupilot": ".parm", "csv_table": ".csv", "c": "", "mat": ".mat"}
NOISE = {"kalibr": ".yaml", "openvins": ".yaml"}
LINES = {".params": r"1\t1\t[A-Z0-9_]+\t[-+.\de]+\t[69]", ".parm": r"[A-Z0-9_]+ [-+.\de]+"}


def prepare(folder: Path) -> None:
    """Make a recording and a map."""
    base.write_h5(folder / "recording.h5", base.recording())
    (folder / "recording.csv").write_text(base.csv_text(base.recording(70)))
    base.fit_map(folder / "map.json", kind="polynomial", order=3)


def told_by(name: str, text: str) -> str | None:
    """Say what a text lets in on a terminal."""
    strange = {c for c in text if c != "\n" and category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    return f"{name} has U+{ord(min(strange)):04X}" if strange else None


class Elements(HTMLParser):
    """The number of elements of each kind of a page, and whether one acts by itself."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.acts = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Count an element."""
        self.tags[tag] += tag in ("script", "style", "img", "iframe", "object", "link", "a", "title", "meta", "svg")
        if any(name.startswith("on") or (value or "").lower().startswith("javascript:") for name, value in attrs):
            self.acts = tag


def shape(path: Path) -> Any:
    """Return what a reader of its own sees in a file, but for texts; raises ValueError where it sees what none has."""
    if path.suffix == ".mat":
        return len(loadmat(path))
    if path.suffix not in (*LINES, ".yaml", ".json", ".csv", ".html", ".c", ".h"):
        return None
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".html" and (complaint := told_by(path.name, text.replace("\t", ""))):
        raise ValueError(complaint)
    if path.suffix in LINES:
        lines = [line for line in text.splitlines() if not line.startswith("#")]
        if other := [line for line in lines if not re.fullmatch(LINES[path.suffix], line)]:
            raise ValueError(f"a line {other[0]!r}")
        return [line.split()[0 if path.suffix == ".parm" else 2] for line in lines]
    if path.suffix in (".yaml", ".json"):
        return keys(yaml.safe_load(text.removeprefix("%YAML:1.0")) if path.suffix == ".yaml" else json.loads(text))
    if path.suffix == ".csv":
        rows = list(csv.reader(io.StringIO(text, newline="")))
        if any(re.match(r"\s*[=+@\-\uff1d](?![\d.])", cell) for row in rows for cell in row):
            raise ValueError("a cell that is a formula")
        return [len(row) for row in rows if not row[0].startswith("#")]
    if path.suffix == ".html":
        found = Elements(text)
        if found.acts:
            raise ValueError(f"an element {found.acts} that acts by itself")
        return found.tags
    return None


def keys(content: Any) -> Any:
    """Return the names of keys, level by level."""
    if isinstance(content, dict):
        return {name: keys(value) for name, value in content.items()}
    return None


def compiles(folder: Path) -> str | None:
    """Say why C in a folder is none; without a compiler nobody knows."""
    gcc = shutil.which("gcc")
    files = [str(path) for path in folder.glob("*.c")]
    if gcc is None or not files:
        return None
    how = [gcc, "-std=c99", "-fsyntax-only", "-trigraphs", "-Wcomment", "-Werror", "-I", str(folder), *files]
    done = subprocess.run(how, capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else f"C that is none: {done.stderr[:300]}"


class Bench:
    """Each place, with each text."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        self.map = json.loads((folder / "map.json").read_text())
        self.wanted: dict[tuple[str, str], dict[str, Any]] = {}
        for place, target in sorted(PLACES):
            said = self.done(place, target, PLAIN if place != "unit" else "rad/s", case)
            if isinstance(said, Outcome) or said.refused():
                if place not in ("kind",):
                    raise RuntimeError(f"{place} to {target}: a plain text is refused: {said}")
                continue
            self.wanted[place, target] = self.seen(case)
            clear(case)

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Put a text in a place, and judge what is said and written."""
        place, target = sorted(PLACES)[number % len(PLACES)]
        text = TEXTS[int(rng.integers(len(TEXTS)))] if rng.random() < 0.8 else mixed(rng)
        said = self.done(place, target, text, folder)
        if isinstance(said, Outcome):
            return said
        for name, out in (("standard output", said.out), ("standard error", said.err)):
            if complaint := told_by(name, out):
                return Outcome("nonsense", f"let in: {place} to {target}: {complaint}", f"{text!r}\n{out!r}")
            if BROKEN.search(text) and any(line.startswith("EVIL") for line in out.splitlines()):
                return Outcome("nonsense", f"let in: {place} to {target}: a line of {name}", f"{text!r}\n{out}")
        if refused := said.refused():
            return refused
        try:
            found = self.seen(folder)
        except Exception as error:
            return Outcome("nonsense", f"let in: {place} to {target}: {str(error)[:80]}", f"{text!r}\n{error}")
        wanted = self.wanted.get((place, target), found)
        if found != wanted:
            return Outcome("nonsense", f"let in: {place} to {target}: another content", f"{text!r}\n{found}\n{wanted}")
        return Outcome("accepted")

    def seen(self, folder: Path) -> dict[str, Any]:
        """Return the shapes of what was written, by the ends of the names."""
        out = folder / "out"
        files = [path for path in (out.rglob("*") if out.is_dir() else ()) if path.is_file()]
        if problem := compiles(out):
            raise ValueError(problem)
        shapes = {path.suffix if path.suffix in (".c", ".h") else path.name: shape(path) for path in sorted(files)}
        shapes.get("loss.json", {}).pop("written", None)  # by names of files, which C has from the channel
        return shapes

    def done(self, place: str, target: str, text: str, folder: Path) -> Said | Outcome:
        """Have the program write, into the folder `out`, what names a text in a place."""
        (folder / "out").mkdir()
        if place in MAP:
            path = self._map(place, text, folder)
            return path if isinstance(path, Outcome) else self._of_map(target, path, folder)
        if place == "serial":
            content = base.config(base.source("hdf5", path=str(self.folder / "recording.h5")))
            base.write_config(folder / "config.yaml", {"serial": text, **content})
            if target == "run":
                return program("run", "config.yaml", "--out", "out")
            return program("export", target, "config.yaml", "--out", f"out/file{NOISE[target]}", "--set", "rate=200 Hz")
        if place == "column":
            return self._column(target, text, folder)
        return self._file(target, text, folder)

    def _map(self, place: str, text: str, folder: Path) -> Path | Outcome:
        record = dict(self.map["record"])
        if place == "axis":
            record["axes"] = ["x", "y", text if text != PLAIN else "z"]
        elif place.startswith("provenance"):
            record["provenance"] = {**record["provenance"], **({"a": text} if place == "provenance" else {text: "a"})}
        elif place == "device_id":
            record["provenance"] = {**record["provenance"], "device_id": text if text != PLAIN else "1310988"}
        else:
            record[place] = {"why": text} if place == "memory" else text
        if text == PLAIN and place in ("kind", "unit", "channel"):
            record[place] = self.map["record"].get(place, "rad/s")
        path = folder / "map.json"
        path.write_text(json.dumps({**self.map, "record": record}))
        return path

    def _of_map(self, target: str, path: Path, folder: Path) -> Said:
        if target == "check":
            settings = {"kind": "polynomial", "path": str(path)}
            content = base.config(base.source("hdf5", path=str(self.folder / "recording.h5")), calibration=settings)
            base.write_config(folder / "config.yaml", content)
            return program("check", "config.yaml")
        more = ["--set", "device_id=1310988"] if target == "px4" else []
        out = "out" if target == "c" else f"out/file{EXPORTS[target]}"
        return program("export", target, path.name, "--out", out, *more)

    def _column(self, target: str, text: str, folder: Path) -> Said | Outcome:
        if target == "h5":
            path = folder / "recording.h5"
            shutil.copy(self.folder / "recording.h5", path)
            try:
                with h5py.File(path, "r+") as file:
                    file[text] = np.arange(len(file["time"][:]))
            except (ValueError, TypeError, UnicodeEncodeError, OSError):
                return Outcome("clean", detail="HDF5 has no such name")
        else:
            path = folder / "recording.csv"
            head, _, rows = (self.folder / "recording.csv").read_text().partition("\n")
            buffer = io.StringIO()
            csv.writer(buffer, lineterminator="\n").writerow([*head.split(","), text])
            table = "".join(f"{row},1\n" for row in rows.splitlines())
            path.write_bytes((buffer.getvalue() + table).encode(errors="surrogatepass"))
        return program("init", path.name, "--out", "out/config.yaml")

    def _file(self, target: str, text: str, folder: Path) -> Said | Outcome:
        path = folder / f"{text}.h5"
        try:
            shutil.copy(self.folder / "recording.h5", path)
        except (OSError, ValueError):
            return Outcome("clean", detail="a file system has no such name")
        if target == "init":
            return program("init", str(path), "--out", "out/config.yaml")
        base.write_config(folder / "config.yaml", base.config(base.source("hdf5")))
        more = ["--report", "out"] if target == "fit-map" else []
        out = "out/map.json" if target == "fit-map" else "out"
        return program(target, "config.yaml", "--input", str(path), "--out", out, *more)


PLACES = (
    [(place, target) for place in MAP for target in (*EXPORTS, "check")]
    + [("serial", target) for target in (*NOISE, "run")]
    + [("column", "csv"), ("column", "h5"), ("file", "init"), ("file", "run"), ("file", "fit-map")]
)


def mixed(rng: RNG) -> str:
    """Return several texts in one."""
    return "".join(TEXTS[k] for k in rng.integers(len(TEXTS), size=rng.integers(1, 4)))


def clear(folder: Path) -> None:
    """Remove what a case has left."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
