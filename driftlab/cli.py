"""The command line: its commands, and errors in one sentence.

Exit status: 0 done, 1 the data or the run failed, 2 usage or config.
"""

from __future__ import annotations

import gc
import io
import os
import re
import signal
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from driftlab.commands.options import ENFORCE_LIMITS, JSON, NEEDED, Command, Deferred, Option
from fusion_core.escaping import lines

INTERRUPTED = 130
MIN_COLUMNS = 20  # columns of a terminal: below, `COLUMNS` is some program's mistake
COUNTS = ("NUMBA_NUM_THREADS", "POLARS_MAX_THREADS", "NUMBA_DISABLE_JIT")  # variables that libraries die of
CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]")  # a line end, or what acts on a terminal

PORT = 8088  # of the page of a live run, where none is named


class WithPort(TyperCommand):
    """A command whose `--web` may stand alone, or with a port behind it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Name the port where none is named."""
        named = [
            f"--web={PORT}" if arg == "--web" and not following.isdecimal() else arg
            for arg, following in zip(args, [*args[1:], ""], strict=True)
        ]
        return super().parse_args(ctx, named)


LIMITED = {"enforce_limits": ENFORCE_LIMITS, "json": JSON}
SIZES = {
    "select": Option("--select", "Choose the number of neurons first (onnx_network), and show why."),
    "neurons_max": Option("--neurons-max N", "Largest number that --select tries.", int, 10, {"min": 1, "max": 20}),
}
COMMANDS = (
    Command("run", "filtering", options=LIMITED, defaults={"out": Path("driftlab_out")}),
    Command(
        "fit_map",
        "fitting",
        metavars={"data": "SOAK[::START:STOP]", "out": "MAP"},
        options=SIZES | LIMITED,
        several=True,
    ),
    Command("allan", "reading", options=LIMITED, measuring=True),
    Command(
        "compare",
        "comparing",
        options={"paper": Option("--paper", "Print the paper's tables 5 to 12 too, in SI."), "json": JSON},
    ),
    Command("explain", "explaining", defaults={"out": NEEDED}),
    Command(
        "fleet",
        module="driftlab.production.fleet",
        metavars={"out": "FLEET"},
        options={
            "units": Option("--units 'GLOB'|MANIFEST.csv", "", str, NEEDED),
            "workers": Option("--workers N", "", int, None, {"min": 1}),
            **LIMITED,
        },
        indent=1,
    ),
    Command(
        "plan", "planning", options={"effects": Option("--effects KIND,...", kind=str, default=None), "json": JSON}
    ),
    Command("simulate", "simulating", metavars={"out": "FILE", "framing": "CONFIG", "speed": "N"}),
    Command("live", options={}, kind=WithPort),
    Command("check", "reading"),
    Command(
        "init",
        "reading",
        metavars={"out": "CONFIG"},
        options={"go": Option("--go", "Fit its map at once, name the map there, show its page."), "json": JSON},
    ),
    Command("export", "exporting", metavars={"out": "PATH"}),
    Command("vehicle", "fitting", defaults={"out": NEEDED}),
    Command("import_map", "importing", title="import", metavars={"out": "MAP"}),
    Command("plugins", module="driftlab.commands.check", metavars={"family": "NAME"}, options={}),
    Command("schema", module="driftlab.commands.check", options={}),
)


class Commands(TyperGroup):
    """All of the commands."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings | {"commands": [Deferred(command) for command in COMMANDS]})


app = typer.Typer(
    name="driftlab",
    cls=Commands,
    help="Thermal calibration and zero-velocity filtering of inertial units.",
    epilog="--debug, with any command, shows what a plugin raised as a whole.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(asked: bool) -> None:
    if asked:
        from driftlab import __version__

        sys.stdout.write(f"driftlab {__version__}\n")
        raise typer.Exit


@app.callback()
def _driftlab(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Thermal calibration and zero-velocity filtering of inertial units."""


def main() -> None:
    """Run the command line; errors that a user can cause end in one message and no traceback."""
    # a million objects come with the imports, and all of them stay: looking through them again and again, and once
    # more at the end, takes a third of a short run
    gc.set_threshold(100_000, 50, 50)
    # matrices are small: threads of BLAS would wait for one another, and hold up those of the program
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from fusion_core.errors import ConfigError, FusionError, UnitError

    _open_streams()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that what is temporary is removed
    # each handler ends the process while it still holds the error: what the error holds is not taken apart
    try:
        _run()
    except (ConfigError, UnitError) as error:
        _leave(str(error), 2)
    except FusionError as error:
        if os.environ.get("DRIFTLAB_DEBUG", "0") != "0":
            sys.stderr.write(lines(traceback.format_exc()))
        _leave(str(error), 1)
    except BrokenPipeError:
        _leave("standard output was closed before everything was printed; files are written all the same", 1)
    except OSError as error:
        name = error.filename if error.filename is not None else "standard output"
        _leave(f"{name}: cannot be read or written ({error.strerror or error}); make room, or check the rights", 1)
    except KeyboardInterrupt as stopped:
        what_is_left = str(stopped) or "what was written so far is in the folder with the suffix .partial"
        _leave(f"interrupted; {what_is_left}", INTERRUPTED)
    except Exception:
        sys.stderr.write(lines(traceback.format_exc()))
        _leave(None, 1)
    gc.freeze()


def _open_streams() -> None:
    """Give a standard stream that is closed a device that takes everything, and let none fail for a character.

    The next file that is opened would have its number, and take what libraries print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper) and number:
            stream.reconfigure(errors="replace")


def _run() -> None:
    from fusion_core.errors import ConfigError, quote

    if "--debug" in sys.argv:  # of every command: what a plugin raised is shown whole
        sys.argv.remove("--debug")
        os.environ["DRIFTLAB_DEBUG"] = "1"
    for name in COUNTS:
        value, least = os.environ.get(name, "1"), int(name.endswith("THREADS"))
        if not (value.isdecimal() and int(value) >= least):
            given = f"{name}='{quote(value)}'"
            raise ConfigError(f"{given}: a whole number from {least} on was expected of this variable; unset it")
    for argument in sys.argv[1:]:
        if not argument.isascii() and argument != argument.encode(errors="replace").decode():
            raise ConfigError(f"'{quote(argument)}': is not UTF-8 text; rename the file, results could not name it")
        if CONTROL.search(argument):
            raise ConfigError(f"'{quote(argument)}': has a control character; rename the file, or leave it out")
    columns = os.environ.get("COLUMNS", "")
    if columns.isdecimal() and int(columns) < MIN_COLUMNS:
        del os.environ["COLUMNS"]
    try:
        app()
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):
            raise ended.__context__ from None
        if ended.code == INTERRUPTED:
            raise KeyboardInterrupt(*_interruption(ended)) from ended
        sys.stdout.flush()
        if ended.code:
            raise


def _interruption(ended: BaseException) -> tuple[object, ...]:
    """Return the arguments of the interruption that ended a command."""
    error: BaseException | None = ended
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return () if error is None else error.args


def _leave(text: str | None, status: int) -> NoReturn:
    """Say what went wrong and end at once.

    After a failure the ends of the libraries themselves may crash (HDF5 on a full disk), or wait for a thread for ever
    that holds the lock of h5py.
    """
    for folder in getattr(sys.modules.get("fusion_core.budget"), "FOLDERS", ()):
        folder.cleanup()
    with suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
    with suppress(OSError, ValueError, AttributeError):
        if text is not None:
            sys.stderr.write(f"driftlab: {lines(text)}\n")
        sys.stderr.flush()
    os._exit(status)
