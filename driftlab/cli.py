"""The command line: its commands, and errors in one sentence.

Exit status: 0 done, 1 the data or the run failed, 2 usage or config.
"""

from __future__ import annotations

import gc
import os
import sys
import traceback
from contextlib import suppress

import typer

from driftlab.commands.allan import allan
from driftlab.commands.compare import compare
from driftlab.commands.explain import explain
from driftlab.commands.fit_map import fit_map
from driftlab.commands.inspect import check, plugins, schema
from driftlab.commands.live import live
from driftlab.commands.run import run
from driftlab.commands.simulate import simulate

INTERRUPTED = 130

app = typer.Typer(
    name="driftlab",
    help="Thermal calibration and zero-velocity filtering of inertial units.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (run, fit_map, allan, compare, explain, simulate, live, check, plugins, schema):
    app.command(command.__name__.replace("_", "-"))(command)


def main() -> None:
    """Run the command line; errors that a user can cause end in one message and no traceback."""
    # a million objects come with the imports, and all of them stay: looking through them again and again, and once
    # more at the end, takes a third of a short run
    gc.set_threshold(100_000, 50, 50)
    status = _status()
    gc.freeze()
    if status:
        # at once: after a failure the libraries' own ends may crash (HDF5 on a full disk) or wait for a thread for ever
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(status)


def _status() -> int:
    """Run the command and return its exit status; what went wrong is said."""
    from fusion_core.errors import ConfigError, FusionError, UnitError

    try:
        try:
            app()
        except SystemExit as ended:
            if isinstance(ended.__context__, BrokenPipeError):
                raise ended.__context__ from None
            sys.stdout.flush()
            if ended.code == INTERRUPTED:
                raise KeyboardInterrupt from None
            return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except (ConfigError, UnitError) as error:
        return _said(str(error), 2)
    except FusionError as error:
        return _said(str(error), 1)
    except BrokenPipeError:
        return _said("standard output was closed before everything was printed; files are written all the same", 1)
    except OSError as error:
        name = error.filename if error.filename is not None else "standard output"
        return _said(
            f"{name}: cannot be read or written ({error.strerror or error}); make room, or check the rights", 1
        )
    except KeyboardInterrupt:
        return _said("interrupted; what was written so far is in the folder with the suffix .partial", INTERRUPTED)
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def _said(text: str, status: int) -> int:
    with suppress(OSError, AttributeError):
        sys.stderr.write(f"driftlab: {text}\n")
    return status
