"""A first config of a file that is new: `driftlab init`."""

from __future__ import annotations

import os
import signal
import sys
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import Any

from driftlab.commands.console import load, say, say_lines, session
from driftlab.commands.inputs import Place, config_of
from driftlab.config import with_recording
from driftlab.starter import config_text, reading
from driftlab.starter.columns import FIELDS, Answers, channels_in, channels_of, noise_of_column
from driftlab.starter.config_text import OpenQuestion, Starter
from driftlab.starter.problems import problems_of
from driftlab.storage.map_file import check_file, write_text
from driftlab.storage.ownership import seal_of, with_own
from driftlab.storage.recorder import written_units
from fusion_core.budget import check_all, of_all
from fusion_core.contracts import Channel
from fusion_core.errors import (
    ConfigError,
    DataError,
    EmptyRecording,
    FusionError,
    MissingChannel,
    UnitError,
    UnreadableFile,
)
from fusion_core.escaping import line
from fusion_core.units import to_si

COMMAND = "init"  # by which its files are known
SIGNS = {"comma": ",", "point": "."}
SHOWN = 12  # answers at a time


@dataclass(frozen=True)
class FirstConfig:
    """The text of a config, what it leaves to be filled in, what speaks against the data, and where it was written."""

    text: str
    asked: tuple[str, ...]
    path: Path | None = None
    problems: tuple[str, ...] = ()

    @property
    def status(self) -> int:
        """Exit status: 1 where something is to be filled in, or speaks against the data."""
        return int(bool(self.asked or self.problems))


class NoSensor(MissingChannel):
    """There is no column that is known as a sensor's; `question` is one that a person can answer."""

    question: OpenQuestion


def init(
    file: Place,
    *,
    out: Place | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    interval: str | None = None,
    decimal: str | None = None,
    dates: str | None = None,
) -> FirstConfig:
    """Write a first config of a file, with every guess marked.

    It has the source, channels, units and noise, and its data are looked into. FILE is a log of PX4 (.ulg) or ArduPilot
    (.bin), a ROS bag, CSV or another text of a logger, Excel (.xlsx), HDF5, NetCDF, MATLAB's .mat, Parquet, or the
    bytes of a device that an installed framing knows; packed with gzip too. In a terminal it asks what it cannot know.

    Parameters
    ----------
    file : path
        A recording, or the bytes that a device sent.
    out : path, optional
        The config to write; by default FILE's name .yaml.
        A program writes nothing where it is left out. One that `init` wrote and nobody changed is replaced.
    columns : mapping of str to str, optional
        Columns of a channel, one an axis, e.g. gyro=wx,wy,wz; repeatable.
        As `{"gyro": "wx,wy,wz"}`; the beginning of a name is enough where one column alone begins so.
    units : mapping of str to str, optional
        A unit that you know, e.g. gyro=deg/s; repeatable.
        As `{"gyro": "deg/s"}`.
    interval : str, optional
        Time between rows, e.g. '10 ms', where no column is a time.
    decimal : str, optional
        Decimal sign of a text: comma or point.
    dates : str, optional
        First part of dates as 03/04/2026: day or month.

    Returns
    -------
    FirstConfig
        `text`, YAML with every guess marked, `asked`, what is left to be filled in, and `problems` of the data.

    Raises
    ------
    ConfigError, UnitError
        If the config is there and was changed, or an option is wrong.
    DataError
        If nothing reads the file, it has no rows, or no channel that is known.
    """
    path, place = Path(file), None if out is None else Path(out)
    answers = _answers(columns, units, interval, decimal, dates)
    if place is not None:
        check_file(place, COMMAND, f"--out {place}", "name another file")
    with of_all(path, "finding out what it holds"):
        starter = _guess(path, os.path.relpath(path, Path() if place is None else place.parent), answers)
        problems = _problems(starter, path)
    text = f"{starter.text}# {seal_of(COMMAND)}\n"
    if place is not None:
        write_text(place, text, COMMAND)
    return FirstConfig(with_own(text), starter.asked, place, problems)


def _answers(
    columns: Mapping[str, str] | None,
    units: Mapping[str, str] | None,
    interval: str | None,
    decimal: str | None,
    dates: str | None,
) -> Answers:
    for option, given in (("--column", columns or {}), ("--unit", units or {})):
        for field, value in given.items():
            if field not in FIELDS:
                raise ConfigError(
                    f"{option} {field}={value}: no channel is called so; known: {', '.join(FIELDS)}; name another "
                    "sensor's in the config that is written"
                )
    for field, unit in (units or {}).items():
        Channel(path="?", unit=unit).check(field)
    if interval is not None and not to_si(interval, "s") > 0:
        raise ConfigError(f"--interval {interval}: a positive time was expected; write e.g. 10 ms")
    if decimal is not None and decimal not in (*SIGNS, *SIGNS.values()):
        raise ConfigError(f"--decimal {decimal}: is no decimal sign; write comma or point")
    if dates is not None and dates not in reading.ORDERS:
        raise ConfigError(f"--dates {dates}: is no part of a date that stands first; write day or month")
    return Answers(columns or {}, units or {}, interval, SIGNS.get(decimal or "", decimal), dates)


def _problems(starter: Starter, path: Path) -> tuple[str, ...]:
    try:
        return starter.problems + tuple(problems_of(with_recording(config_of(starter.text, measuring=True), str(path))))
    except (ConfigError, UnitError):
        if starter.asked:  # which is why it cannot be read yet
            return starter.problems
        raise


def _guess(file: Path, path: str, given: Answers) -> Starter:
    first, errors = b"" if file.is_dir() else reading.beginning(file, reading.HEAD), list[FusionError]()
    known = {"interval": given.interval, "decimal": given.decimal}
    known = {key: value for key, value in known.items() if value is not None}
    for cls in reading.file_sources(file, first):
        if cls.product is not None:
            return config_text.of_product(path, file.name, cls.product, _map_name(file))
        try:
            columns = reading.columns_of(file, cls, known, given.dates)
        except DataError as error:
            check_all()
            errors.append(error)
            continue
        return _of_columns(file, path, columns, given)
    frames = None if file.is_dir() else reading.framing_of(file)
    if frames is None:
        raise reading.nothing_reads(file, errors)
    frames, samples = reading.samples_of(file, frames, given.interval)
    channels = None if samples is None else channels_in(samples)
    return config_text.of_frames(path, file.name, frames, channels, _map_name(file))


def _of_columns(file: Path, path: str, columns: reading.FileColumns, given: Answers) -> Starter:
    if not any(map(len, columns.values.values())):
        if columns.unread:
            raise UnreadableFile(f"{file}: no column holds numbers: {config_text.unread_of(columns, None)[0]}")
        raise EmptyRecording(
            f"{file}: has the {columns.noun}s {_listed(columns.names)} and no rows of numbers; record anew"
        )
    written = written_units(file) if columns.kind == "csv" else {}
    channels = channels_of(columns, given, written)
    held = config_text.held_of(columns, channels)
    if held is None and "gyro" not in channels.found:
        raise _no_sensor(file, columns)
    if held is not None and (noise := noise_of_column(columns, held.path, channels.found)) is not None:
        channels = replace(channels, noise={held.path: noise})
    return config_text.of_columns(path, file.name, columns, channels, _map_name(file))


def _no_sensor(file: Path, columns: reading.FileColumns) -> NoSensor:
    unread = f" (no numbers in {_listed(list(columns.unread))})" if columns.unread else ""
    error = NoSensor(
        f"{file}: no {columns.noun} is called like a gyro; it has {_listed(columns.names)}{unread}; name those of its "
        "axes, as in --column gyro=wx,wy,wz"
    )
    error.question = config_text.of_a_sensor(columns)
    return error


def _listed(names: list[str]) -> str:
    return ", ".join(names[:30]) + (f" and {len(names) - 30} more" if len(names) > 30 else "") if names else "none"


def _map_name(file: Path) -> str:
    """Return the name that `fit-map` gives the map of a config that is called as the file."""
    return f"{_stem(file)}.map.json"


def _stem(file: Path) -> str:
    return file.name.split(".")[0] or "unit"


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Name the config as the file, in the working directory, where no other place is given; ask, in a terminal."""
    arguments = {"out": Path(f"{_stem(arguments['file'])}.yaml"), **arguments}
    if sys.stdin.isatty() and sys.stdout.isatty() and not (options["json"] or session().quiet):
        try:
            _interview(arguments)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("nothing was written") from None
    return arguments


def _interview(arguments: dict[str, Any]) -> None:
    """Ask what the file does not say, one by one, and put the answers among the arguments."""
    asked, question, before = set[tuple[str, str]](), None, None
    while True:
        given = {name: arguments.get(name) for name in ("columns", "units", "interval", "decimal", "dates")}
        try:
            with of_all(arguments["file"], "finding out what it holds"):
                questions = _guess(arguments["file"], "", _answers(**given)).questions
        except NoSensor as error:
            questions = (error.question,)
        except (ConfigError, UnitError) as error:
            if question is None:
                raise
            say(f"{error}\n")  # and ask again
            arguments[question.option], questions = before, (question,)
            asked.discard((question.option, question.field))
        question = next((q for q in questions if (q.option, q.field) not in asked), None)
        if question is None:
            return
        asked.add((question.option, question.field))
        before = arguments.get(question.option)
        if answer := _ask(question):
            arguments[question.option] = {**(before or {}), question.field: answer} if question.field else answer


def _ask(question: OpenQuestion) -> str:
    """Ask a person; return the answer, by its number or in words: without one the guess, or nothing."""
    from prompt_toolkit.utils import is_dumb_terminal

    choices = (*question.choices, "") if question.needed else question.choices
    rows = [f"{k}) {choice or 'leave it open'}" for k, choice in enumerate(choices, 1)]
    usual = len(rows) - 1 if question.needed else 0
    rows[0] += "" if question.needed else "   (the guess)"
    answer = (_typed if is_dumb_terminal() else _picked)(line(question.text), list(map(line, rows)), usual)
    known = {str(k): choice for k, choice in enumerate(choices, 1)}
    words = (word.strip() for word in (answer.strip(", \n") or str(usual + 1)).split(","))
    return ",".join(known.get(word, word) for word in words)


def _typed(text: str, rows: list[str], usual: int) -> str:
    """Return a line that a person types."""
    signal.signal(signal.SIGINT, signal.getsignal(signal.SIGINT))  # after that of polars, which goes on reading
    say_lines(["", text, *rows])
    sys.stdout.write(f"number or text [{usual + 1}]: ")
    sys.stdout.flush()
    return sys.stdin.readline()


def _picked(text: str, rows: list[str], usual: int) -> str:
    """Return a line that a person types, or the number of the row that the arrow keys lead to."""
    from prompt_toolkit import prompt
    from prompt_toolkit.formatted_text import AnyFormattedText
    from prompt_toolkit.key_binding import KeyBindings, KeyPressEvent

    keys, place = KeyBindings(), usual

    def screen() -> AnyFormattedText:
        begin = max(0, min(place - SHOWN // 2, len(rows) - SHOWN))
        shown = list(enumerate(rows))[begin : begin + SHOWN]
        marked = [("bold", f"> {row}\n") if k == place else ("", f"  {row}\n") for k, row in shown]
        folded = fill(text, max(get_terminal_size().columns - 1, 20))
        return [("", f"\n{folded}\n"), *marked, ("", "arrow keys and Enter (Tab: several), a number, or text: ")]

    @keys.add("up")
    @keys.add("down")
    def move(event: KeyPressEvent) -> None:
        nonlocal place
        place = (place + (1 if event.key_sequence[0].key == "down" else -1)) % len(rows)

    @keys.add("tab")
    def take(event: KeyPressEvent) -> None:
        event.current_buffer.insert_text(f"{place + 1},")

    try:
        return prompt(screen, key_bindings=keys) or str(place + 1)
    except EOFError:
        return ""


def content_of(result: FirstConfig, given: Mapping[str, Any]) -> Any:
    """Return the config's place and text, and what is left to do."""
    left = {"to_fill_in": list(result.asked), "problems": list(result.problems)}
    return {"config": str(result.path), "text": result.text, **left}


def show(result: FirstConfig, given: Mapping[str, Any]) -> None:
    """Print the config, what is to be filled in, what speaks against the data, and the next command."""
    say(result.text)
    say_lines(result.asked, "fill in: ")
    say_lines(result.problems, "problem: ")
    if result.status:
        say(f"written to {result.path}\n")
        remedy = "mend what speaks against it, or go on all the same with `driftlab fit-map`"
        if result.asked:
            remedy = "say what is missing with --column, --unit, --interval or --dates, or write it there"
        sys.stderr.write(f"driftlab: {line(str(given['file']))}: is not ready for a map; {remedy}\n")
        return
    if given.get("go"):
        say(f"written to {result.path}; look at what is guessed. Now: driftlab fit-map {result.path}\n")
        _fit(result)
    else:
        say(f"written to {result.path}; look at what is guessed, then: driftlab fit-map {result.path}\n")


def _fit(first: FirstConfig) -> None:
    """Fit the map of a config, write it there, print how good it is, and show its page."""
    from driftlab.commands import fit_map  # with all that fits, which a first config does not need

    path, options = first.path or Path(), {"select": False, "enforce_limits": False}
    arguments = fit_map.arguments_of({"config": load(path), "compare": False, "certificate": False}, options)
    result = fit_map.fit_map(**arguments)
    place = os.path.relpath(result.written[0], path.parent)
    bare = first.text.rpartition("# ")[0]  # without its SHA-256
    text = config_text.with_map(bare, result.map.record.kind, place)
    if text != bare:
        write_text(path, f"{text}# {seal_of(COMMAND)}\n", COMMAND)
        result.config = load(path)
    fit_map.show(result, arguments)
    if text != bare:
        say(f"{path} names the map now; next: driftlab run {path}\n")
    page = result.written[1].resolve()
    say(f"the page: {page}\n")
    if sys.stdout.isatty():
        webbrowser.open(page.as_uri())
