"""Mutated CSV files through `driftlab run`, against a reading of them cell by cell."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from torture import base, grammar, recordings
from torture.truth import Truth

CASES, WORKERS, LIMIT, IN_PROCESS = 1_000, 2, 5.0, True
RNG = np.random.Generator
WORDS = {"nan": np.nan, "inf": np.inf, "infinity": np.inf}  # as every language prints them, in any case, with a sign
EMPTY = ("", "n/a", "N/A", "NA", "#N/A", "null", "NULL", "None")  # as spreadsheets, R and databases write it

CELLS = (
    "", " ", "nan", "NaN", "-nan", "inf", "-Infinity", "1e999", "1e-999", "x", "ERR", "1,5", '"1,5"', "1.5.2",
    "1_000", "0x1F", "1e", "e5",
    "--1", "+1e-3", " 0.001 ", '"0.001"', "'0.001'", "0.001f", "1d5", "1 000", "\u0663", "\uff11", "\u2212" "1",
    "1/2", "true", "null", "NA",
    "#N/A", "-", "+", ".", "0.001;", "1e+0", "١", "1e5e5", "0b1", "1j", "(1)", "=1+1", "1.", ".5", "00012",
    "2001-01-01", "12:30:00", "\t1",
)  # fmt: skip


def cell(text: str) -> float | None:
    """Return the number in a cell, NaN where it is empty, None where it is none."""
    text = text.strip(" \t")
    if text in EMPTY:
        return np.nan
    word = WORDS.get(text.lstrip("+-").lower()) if text[:2] not in ("--", "++", "+-", "-+") else None
    return word * (-1 if text[0] == "-" else 1) if word is not None else grammar.number(text)


def truth(path: Path) -> Truth | None:
    """Read a file strictly; None where no reader should."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        text = path.read_bytes().decode("utf-8", "replace").removeprefix("\ufeff")
    whole = text.endswith("\n")
    lines = [line.strip("\r") for line in text.removesuffix("\n").split("\n")]
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        return None
    try:
        header = [name.strip() for name in next(csv.reader([lines[0]]))]
        rows = [next(csv.reader([line], strict=True)) for line in lines[1:-1]]
        last = next(csv.reader([lines[-1]]))
    except (csv.Error, StopIteration):
        return None
    if any(header.count(name) != 1 for name in base.COLUMNS):
        return None
    torn = _torn(last, lines[-1], header, whole)
    rows += [] if torn else [last]
    if any(len(row) != len(header) for row in rows):
        return None
    places = [header.index(name) for name in base.COLUMNS]
    values = [[cell(row[k]) for k in places] for row in rows]
    if any(value is None for row in values for value in row):
        return None
    table = np.array(values, dtype=np.float64).reshape(len(rows), len(places))
    return Truth(
        {"time": table[:, 0], "gyro": table[:, 1:4], "accel": table[:, 4:7], "temperature": table[:, 7]}, int(torn)
    )


def _torn(last: list[str], line: str, header: list[str], whole: bool) -> bool:
    if len(last) < len(header):
        return True
    return not whole and len(last) == len(header) and (line.count('"') % 2 == 1 or cell(last[-1]) is None)


def of_cell(lines: list[str], rng: RNG) -> list[str]:
    """Write something else in a cell, or in many."""
    for _ in range(int(rng.choice([1, 1, 1, 40]))):
        k = int(rng.integers(1, len(lines))) if rng.random() < 0.8 else len(lines) - 1
        cells = lines[k].rstrip("\n").split(",")
        cells[rng.integers(len(cells))] = CELLS[rng.integers(len(CELLS))]
        lines[k] = ",".join(cells) + "\n"
    return lines


def of_lines(lines: list[str], rng: RNG) -> list[str]:
    """Remove, repeat, swap, insert, join or tear lines."""
    k, j = rng.integers(1, len(lines), 2).tolist()
    insert = [
        "\n",
        "# a comment\n",
        "#\n",
        ",,,,,,,\n",
        " \n",
        "0\n",
        lines[0],
        '"\n',
        ",\n",
        "\r",
        "x" * 5000 + "\n",
        ";" * 7 + "\n",
    ]
    match rng.integers(8):
        case 0:
            del lines[k : k + int(rng.choice([1, 20, 600]))]
        case 1:
            lines.insert(k, lines[k])
        case 2:
            lines[k], lines[j] = lines[j], lines[k]
        case 3 | 4:
            lines.insert(k, insert[rng.integers(len(insert))])
        case 5:
            lines[k] = lines[k].rstrip("\n") + ["", ",", ",1", ",1,2"][rng.integers(4)] + ["", "\n"][rng.integers(2)]
        case 6:
            lines[k] = lines[k].rpartition(",")[0] + "\n"
        case _:
            lines.append(lines[-1][: rng.integers(len(lines[-1]))])
    return lines


def of_header(lines: list[str], rng: RNG) -> list[str]:
    """Change the names."""
    names = lines[0].rstrip("\n").split(",")
    k, j = rng.integers(len(names), size=2).tolist()
    match rng.integers(9):
        case 0:
            names[k] = names[j]
        case 1:
            names[k], names[j] = names[j], names[k]
        case 2:
            names[k] = ["", "x", names[k].upper(), f'"{names[k]}"', f" {names[k]} ", f"{names[k]} [deg/s]", "1", '"'][
                rng.integers(8)
            ]
        case 3:
            del names[k]
        case 4:
            names.insert(k, ["", "x", names[k], '"a,b"'][rng.integers(4)])
        case 5:
            return [["\n", "# made by x\n", "\ufeff", "sep=,\n", "unit,s,s\n", '"'][rng.integers(6)], *lines]
        case 6:
            return lines[1:]
        case 7:
            return ["\ufeff" + lines[0], *lines[1:]]
        case _:
            return [lines[0].replace(",", ";"), *lines[1:]]
    return [",".join(names) + "\n", *lines[1:]]


def of_text(text: str, rng: RNG) -> bytes:
    """Line ends, separators, encodings, flipped bytes and a file that is cut."""
    raw = bytearray(text.encode())
    match rng.integers(8):
        case 0:
            return text.replace("\n", ["\r\n", "\r", "\n\n", "\r\r\n", "\u2028"][rng.integers(5)]).encode()
        case 1:
            return text.replace(",", [";", "\t", " ", ", ", ",,", "|"][rng.integers(6)]).encode()
        case 2:
            return text.encode(["utf-16", "utf-16-le", "utf-8-sig", "utf-32", "cp500"][rng.integers(5)])
        case 3 | 4:
            for _ in range(int(rng.choice([1, 1, 3, 30]))):
                raw[rng.integers(len(raw))] ^= 1 << int(rng.integers(8))
        case 5:
            return bytes(raw[: rng.integers(len(raw))])
        case 6:
            k = int(rng.integers(len(raw)))
            raw[k : k + int(rng.choice([1, 50, 5000]))] = [b"", b"\x00" * 100, b"\xff\xfe\xfd", b"\r", b'"', b"\n"][
                rng.integers(6)
            ]
        case _:
            i, j = sorted(rng.integers(len(raw), size=2).tolist())
            raw = raw[:i] + raw[i:j] + raw[i:j] + raw[j:]
    return bytes(raw)


def prepare(folder: Path) -> None:
    """Write the table."""
    (folder / "recording.csv").write_text(base.csv_text(base.recording()))


class Bench(recordings.Bench):
    """As of HDF5 recordings."""

    SUFFIX, KIND = ".csv", "csv"

    def truth(self, path: Path) -> Truth | None:
        """Read the file independently of the program."""
        return truth(path)

    def mutate(self, path: Path, rng: RNG) -> None:
        """Write the mutated table."""
        text = self.recording.read_text()
        how = (of_cell, of_cell, of_lines, of_header, None)[rng.integers(5)]
        if how is None:
            path.write_bytes(of_text(text, rng))
        else:
            path.write_text("".join(how(text.splitlines(keepends=True), rng)), encoding="utf-8", newline="")
