"""The command line: its commands, and errors in one sentence.

Exit status: 0 done, 1 the data or the run failed, 2 usage or config.
"""

from __future__ import annotations

import gc
import sys

import typer

from driftlab.commands.allan import allan
from driftlab.commands.compare import compare
from driftlab.commands.explain import explain
from driftlab.commands.fit_map import fit_map
from driftlab.commands.inspect import check, plugins, schema
from driftlab.commands.live import live
from driftlab.commands.run import run
from driftlab.commands.simulate import simulate

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
    from fusion_core.errors import ConfigError, FusionError, UnitError, shown

    try:
        for argument in sys.argv[1:]:
            if not argument.isascii() and argument != argument.encode(errors="replace").decode():
                raise ConfigError(f"'{shown(argument)}': is not UTF-8 text; rename the file, results could not name it")
        app()
    except (ConfigError, UnitError) as error:
        sys.stderr.write(f"driftlab: {error}\n")
        sys.exit(2)
    except FusionError as error:
        sys.stderr.write(f"driftlab: {error}\n")
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except KeyboardInterrupt:
        sys.stderr.write("driftlab: interrupted; what was written so far is in the folder with the suffix .partial\n")
        sys.exit(130)
    finally:
        gc.freeze()
