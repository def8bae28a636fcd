"""The command line: its commands, and errors in one sentence.

Exit status: 0 done, 1 the data or the run failed, 2 usage or config.
"""

from __future__ import annotations

import gc
import io
import os
import re
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, NoReturn

import typer

from driftlab.commands.allan import allan
from driftlab.commands.compare import compare
from driftlab.commands.explain import explain
from driftlab.commands.export import export
from driftlab.commands.fit_map import fit_map
from driftlab.commands.fleet import fleet
from driftlab.commands.import_map import import_map
from driftlab.commands.init import init
from driftlab.commands.inspect import check, plugins, schema
from driftlab.commands.live import live
from driftlab.commands.live_web import LiveCommand
from driftlab.commands.plan import plan
from driftlab.commands.run import run
from driftlab.commands.session import with_session
from driftlab.commands.simulate import simulate
from fusion_core.escaping import lines

INTERRUPTED = 130
NARROWEST = 20  # columns of a terminal: below, `COLUMNS` is some program's mistake
COUNTS = ("NUMBA_NUM_THREADS", "POLARS_MAX_THREADS", "NUMBA_DISABLE_JIT")  # variables that libraries die of
CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]")  # a line end, or what acts on a terminal

app = typer.Typer(
    name="driftlab",
    help="Thermal calibration and zero-velocity filtering of inertial units.",
    epilog="--debug, with any command, shows what a plugin raised as a whole.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS: tuple[Callable[..., None], ...] = (run, fit_map, allan, compare, explain, fleet, plan, simulate, live, check)
for command in COMMANDS:
    kind = LiveCommand if command is live else None
    app.command(command.__name__.replace("_", "-"), cls=kind)(with_session(command))
BESIDE: dict[str, Callable[..., None]] = {
    "init": init,
    "export": export,
    "import": import_map,
    "plugins": plugins,
    "schema": schema,
}
for name, command in BESIDE.items():  # the --set of export and import is of the form
    app.command(name)(with_session(command, config=False))


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
    from fusion_core.errors import ConfigError, FusionError, UnitError

    _open_streams()
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
        said = str(stopped) or "what was written so far is in the folder with the suffix .partial"
        _leave(f"interrupted; {said}", INTERRUPTED)
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
    from fusion_core.errors import ConfigError, shown

    if "--debug" in sys.argv:  # of every command: what a plugin raised is shown whole
        sys.argv.remove("--debug")
        os.environ["DRIFTLAB_DEBUG"] = "1"
    for name in COUNTS:
        value, least = os.environ.get(name, "1"), int(name.endswith("THREADS"))
        if not (value.isdecimal() and int(value) >= least):
            raise ConfigError(
                f"{name}='{shown(value)}': a whole number from {least} on was expected of this variable; unset it"
            )
    for argument in sys.argv[1:]:
        if not argument.isascii() and argument != argument.encode(errors="replace").decode():
            raise ConfigError(f"'{shown(argument)}': is not UTF-8 text; rename the file, results could not name it")
        if CONTROL.search(argument):
            raise ConfigError(f"'{shown(argument)}': has a control character; rename the file, or leave it out")
    columns = os.environ.get("COLUMNS", "")
    if columns.isdecimal() and int(columns) < NARROWEST:
        del os.environ["COLUMNS"]
    try:
        app()
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):
            raise ended.__context__ from None
        if ended.code == INTERRUPTED:
            raise KeyboardInterrupt(*_said(ended)) from ended
        sys.stdout.flush()
        if ended.code:
            raise


def _said(ended: BaseException) -> tuple[object, ...]:
    """Return what was said with the interruption that ended a command."""
    error: BaseException | None = ended
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return () if error is None else error.args


def _leave(text: str | None, status: int) -> NoReturn:
    """Say what went wrong and end at once.

    After a failure the ends of the libraries themselves may crash (HDF5 on a full disk), or wait for a thread for ever
    that holds the lock of h5py.
    """
    with suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
    with suppress(OSError, ValueError, AttributeError):
        if text is not None:
            sys.stderr.write(f"driftlab: {lines(text)}\n")
        sys.stderr.flush()
    os._exit(status)
