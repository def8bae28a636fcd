"""C99 from a program: `c99/*.jinja` filled in. Its arithmetic is `c_emulation`'s."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion_core.contracts import Calibrated
from fusion_core.contracts.effect import (
    TEMPERATURE,
    Behind,
    Elapsed,
    Fading,
    Limited,
    PlayState,
    Product,
    Reading,
    Signal,
    Weighted,
    walk,
)
from fusion_core.contracts.exporter import HOUR, warm_up
from fusion_core.errors import ConfigError, shown
from fusion_core.escaping import c_comment
from fusion_plugins.exporters.c.emulation import LONGEST, UPDATES, at_rest, run
from fusion_plugins.exporters.c.program import Program, Single

if TYPE_CHECKING:
    from jinja2 import Environment

PAIRS = 32  # of the self-test
_FAR = 1e30  # degC: outside of every thermometer
_ULPS = 8  # by which other rounding may differ
_TAKEN = (
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|inline|int|long|register|"
    "restrict|return|short|signed|sizeof|static|struct|switch|typedef|union|unsigned|void|volatile|while|"
    "class|delete|new|this|"  # a header is read by C++ too
    "axis|bias|dt|u?int(8|16|32|64)_t|k|main|more|passed|signals|state|temperature|weights|"
    "add|begin|between|duration|is_finite|lagging|playing|product|seen|share_gone|ticking|"
    "table_\\d+|(offset|scale|knots|KNOTS|LOWEST|HIGHEST|PER_UNIT)_\\d+|U?INT\\d+_(C|MAX|MIN)|"
    "COUNT|TOLERANCE|differs|expected|expected_then|temperatures|warm_up|printf|"
    "_Bool|_Complex|_Imaginary|bool|true|false|asm|linux|unix"
)
_LONGEST = 63  # characters of a name that C99 tells apart
_CALLED: dict[type, str] = {
    Behind: "behind",
    Elapsed: "elapsed",
    Fading: "fading",
    Limited: "within",
    PlayState: "play",
    Product: "product_of",
    Weighted: "sum",
}


def identifier(channel: str) -> str:
    """Return a channel's name as one of C."""
    name = _word(channel)
    name = f"c_{name}" if name[:1].isdigit() else name
    of_a_signal = re.fullmatch(rf"({'|'.join(_CALLED.values())}|in)_\w+", name)
    return f"{name}_" if re.fullmatch(_TAKEN, name) or of_a_signal else name


def _word(channel: str) -> str:
    return re.sub(r"\W", "_", channel, flags=re.ASCII)


def single(value: float | np.floating[Any]) -> str:
    """Return a number in single precision as C writes it, in as few digits as tell it from all others."""
    text = str(np.float32(value))
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def row(values: Single) -> str:
    """Return a row of an array as C writes it."""
    return f"{{{', '.join(single(value) for value in values)}}}"


def integers(values: Single) -> str:
    """Return the same of whole numbers."""
    return f"{{{', '.join(str(int(value)) for value in values)}}}"


def files(sensor: Calibrated, program: Program, comment: Sequence[str]) -> dict[str, str]:
    """Return the text of header, source and self-test by their names."""
    _check_names(sensor.channel, program)
    templates = _templates()
    stem = f"{identifier(sensor.channel)}_bias"
    told = {
        "name": stem,
        "NAME": stem.upper(),
        "what": c_comment(f"the {sensor.channel}"),
        "unit": c_comment(sensor.unit),
        "program": program,
        "comment": [c_comment(line) for line in comment],
        "lowest": single(min(table.lowest for table in program.resting)),
        "highest": single(max(table.highest for table in program.resting)),
        **_Code(program).told(),
        **_pairs(sensor, program),
    }
    names = ("bias.h", "bias.c", "bias_test.c")
    return {name.replace("bias", stem, 1): templates.get_template(f"{name}.jinja").render(told) for name in names}


@cache
def _templates() -> Environment:
    import jinja2

    folder = resources.files(__package__) / "c99"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # it is C
    )
    environment.filters |= {"single": single, "row_of_singles": row, "row_of_integers": integers}
    return environment


def _check_names(channel: str, program: Program) -> None:
    """Raise ConfigError where channels have no names of their own in C."""
    known: dict[str, str] = {}
    for name in (channel, *program.channels):
        own = _word(name)
        if not 0 < len(own) <= _LONGEST or not own.strip("_"):
            raise ConfigError(
                f"export c: the channel '{shown(name)}' has no name in C, 1 to {_LONGEST} letters and digits; name it "
                "otherwise"
            )
        if name != channel and (other := known.setdefault(own.strip("_").lower(), name)) != name:
            raise ConfigError(
                f"export c: the channels '{shown(other)}' and '{shown(name)}' have one name in C; name one otherwise"
            )


def _pairs(sensor: Calibrated, program: Program) -> dict[str, Any]:
    """Return temperatures and answers of the self-test."""
    low, high = sensor.fitted.domain
    margin = 0.2 * (high - low)
    inside = np.linspace(low - margin, high + margin, PAIRS - 4)
    T = np.concatenate([[-_FAR, low, high, _FAR], inside]).astype(np.float32)
    expected = at_rest(program, T)
    told: dict[str, Any] = {"count": PAIRS, "temperatures": T, "expected": expected}
    largest = float(np.max(np.abs(expected)))
    if program.remembers:
        step = HOUR / PAIRS
        told |= {"step": step, "constants": [], "arguments": ""}
        recording = warm_up((low, high))
        samples = np.interp(step * np.arange(PAIRS + 1), recording.t, recording["temperature"]).astype(np.float32)
        channels = {"temperature": samples}
        for channel, columns in program.channels.items():
            channels[channel] = np.ones((PAIRS + 1, columns), dtype=np.float32)
            size, ones = ("", "1.0f") if columns == 1 else (f"[{columns}]", f"{{{', '.join(['1.0f'] * columns)}}}")
            told["constants"].append(f"const float {identifier(channel)}{size} = {ones};")
            told["arguments"] += f", {identifier(channel)}"
        dt = np.full(PAIRS + 1, step, dtype=np.float32)
        dt[0] = 0.0
        then = run(program, dt, channels)[1:]
        told |= {"warm_up": samples, "expected_then": then}
        largest = max(largest, float(np.max(np.abs(then))))
    return told | {"tolerance": single(_ULPS * float(np.spacing(np.float32(largest))))}


class _Code:
    """The signals of a program as statements."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.inputs = program.numbered(Reading)
        self.lags = {node: k for k, node in enumerate(n for n in program.nodes if isinstance(n, Behind | Fading))}
        self.plays = program.numbered(PlayState)
        self.clock = program.numbered(Elapsed)
        self.names = dict(self._names())

    def told(self) -> dict[str, Any]:
        """Return what the templates ask for."""
        program = self.program
        parameters = [
            f", float {identifier(channel)}" if columns == 1 else f", const float {identifier(channel)}[{columns}]"
            for channel, columns in program.channels.items()
        ]
        return {
            "parameters": "".join(parameters),
            "inputs": self.inputs,
            "lags": self.lags,
            "plays": self.plays,
            "clock": self.clock,
            "tables": program.tables,
            "resting": [program.tables.index(table) + 1 for table in program.resting],
            "weights": program.weights,
            "longest": single(LONGEST),
            "updates": int(UPDATES),
            "beginning": list(self._beginning()),
            "running": list(self._running()),
            "looked_up": [self.names[table.of] for table in program.tables],
            "signals": [self.names[signal] for signal in program.signals],
        }

    def _names(self) -> Iterator[tuple[Signal, str]]:
        count: dict[str, int] = {}
        for node in self.program.nodes:
            if isinstance(node, Reading):
                column = f"_{node.column}" if node.columns > 1 else ""
                yield node, f"in_{_word(node.channel)}{column}"
                continue
            called = _CALLED[type(node)]
            count[called] = count.get(called, 0) + 1
            yield node, f"{called}_{count[called]}"

    def _seen(self, node: Reading) -> str:
        name = "temperature" if node == TEMPERATURE else identifier(node.channel)
        argument = name if node.columns == 1 else f"{name}[{node.column}]"
        _, lowest, highest = self.program.limits(node)
        return f"seen(&state->inputs[{self.inputs[node]}], {argument}, {single(lowest)}, {single(highest)})"

    def _running(self) -> Iterator[str]:
        if self.lags or self.clock:
            yield "const float passed = duration(dt);"
        for node in self.program.nodes:
            yield f"const float {self.names[node]} = {self._value(node)};"

    def _value(self, node: Signal) -> str:
        match node:
            case Reading():
                return self._seen(node)
            case Elapsed():
                return "ticking(state, passed)"
            case Fading():
                return f"lagging(&state->lags[{self.lags[node]}], passed, 0.0f, {single(node.tau)})"
            case Behind():
                of = self.names[node.of]
                return f"lagging(&state->lags[{self.lags[node]}], passed, {of}, {single(node.tau)})"
            case PlayState():
                return f"playing(&state->plays[{self.plays[node]}], {self.names[node.of]}, {single(node.width / 2)})"
            case Product():
                return f"product({self.names[node.a]}, {self.names[node.b]})"
            case Limited():
                return f"between({self.names[node.of]}, {single(node.low)}, {single(node.high)})"
            case Weighted():
                return self._sum(node)
            case _:
                raise NotImplementedError(f"{type(node).__name__} inside of a signal")

    def _sum(self, node: Weighted) -> str:
        text = ""
        for weight, part in node.terms:
            sign = " - " if weight == -1.0 else " + " if text else ""
            name = self.names[part]
            text += sign.lstrip() if not text else sign
            text += name if abs(weight) == 1.0 else f"product({single(weight)}, {name})"
        return f"{text} + {single(node.offset)}" if node.offset else text

    def _beginning(self) -> Iterator[str]:
        """Yield the statements that begin memories in equilibrium, with the values that they are begun at."""
        begun = [node.of for node in self.program.nodes if isinstance(node, Behind | PlayState)]
        asked = {part for of in begun for part in walk(of)}
        for reading, number in self.inputs.items():
            yield f"state->inputs[{number}] = {single(self.program.limits(reading)[0])};"
        for node in self.program.nodes:
            name = self.names[node]
            match node:
                case Reading():
                    if node not in asked:
                        yield f"(void){self._seen(node)};"
                        continue
                    value = self._seen(node)
                case Elapsed():
                    yield "state->seconds = 0u;"
                    yield "state->fraction = 0.0f;"
                    value = "0.0f"
                case Fading():
                    yield f"begin(&state->lags[{self.lags[node]}], 0.0f, 1.0f);"
                    value = "1.0f"
                case Behind():
                    yield f"begin(&state->lags[{self.lags[node]}], {self.names[node.of]}, 0.0f);"
                    value = "0.0f"
                case PlayState():
                    yield f"state->plays[{self.plays[node]}] = {self.names[node.of]};"
                    value = "0.0f"
                case _:
                    value = self._value(node)
            if node in asked:
                yield f"const float {name} = {value};"
