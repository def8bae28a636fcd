"""C99 of a program: `c99/*.jinja` filled in, whose arithmetic is that of `emulation`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion_core.contracts import Calibrated, effect
from fusion_core.contracts.exporter import HOUR, warm_up
from fusion_core.errors import ConfigError, quote
from fusion_core.escaping import c_comment
from fusion_plugins.exporters.c.emulation import LONGEST, UPDATES, at_rest, inputs, run
from fusion_plugins.exporters.c.program import Program, Single

if TYPE_CHECKING:
    from jinja2 import Environment

PAIRS = 32  # of the self-test
READING = np.array([1.0, -2.0, 0.5], dtype=np.float32)  # of the self-test
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
_NAMES: dict[type, str] = {
    effect.Behind: "behind",
    effect.Elapsed: "elapsed",
    effect.Fading: "fading",
    effect.Limited: "within",
    effect.PlayState: "play",
    effect.Product: "product_of",
    effect.Weighted: "sum",
}


def identifier(channel: str) -> str:
    """Return a channel's name as one of C."""
    name = _word(channel)
    name = f"c_{name}" if name[:1].isdigit() else name
    of_a_signal = re.fullmatch(rf"({'|'.join(_NAMES.values())}|in)_\w+", name)
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
    parameters = (
        f", float {identifier(channel)}" if columns == 1 else f", const float {identifier(channel)}[{columns}]"
        for channel, columns in program.channels.items()
    )
    content = {
        "name": stem,
        "input": f"{identifier(sensor.channel)}_input",
        "NAME": stem.upper(),
        "what": c_comment(f"the {sensor.channel}"),
        "unit": c_comment(sensor.unit),
        "program": program,
        "names": dict(_names(program)),
        "comment": [c_comment(line) for line in comment],
        "parameters": "".join(parameters),
        "longest": LONGEST,
        "updates": int(UPDATES),
        **_answers(sensor, program),
    }
    names = ("bias.h", "bias.c", "bias_test.c")
    return {name.replace("bias", stem, 1): templates.get_template(f"{name}.jinja").render(content) for name in names}


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
    environment.filters |= {
        "single": single, "row_of_singles": row, "row_of_integers": integers, "identifier": identifier,
        "sort_of": lambda signal: type(signal).__name__,
    }  # fmt: skip
    return environment


def _check_names(channel: str, program: Program) -> None:
    """Raise ConfigError where channels have no names of their own in C."""
    known: dict[str, str] = {}
    for name in (channel, *program.channels):
        word = _word(name)
        if not 0 < len(word) <= _LONGEST or not word.strip("_"):
            raise ConfigError(
                f"export c: the channel '{quote(name)}' has no name in C, 1 to {_LONGEST} letters and digits; name it "
                "otherwise"
            )
        if name != channel and (other := known.setdefault(word.strip("_").lower(), name)) != name:
            raise ConfigError(
                f"export c: the channels '{quote(other)}' and '{quote(name)}' have one name in C; name one otherwise"
            )


def _answers(sensor: Calibrated, program: Program) -> dict[str, Any]:
    """Return the temperatures of the self-test and what the code answers to them."""
    low, high = sensor.fitted.domain
    margin = 0.2 * (high - low)
    inside = np.linspace(low - margin, high + margin, PAIRS - 4)
    T = np.concatenate([[-_FAR, low, high, _FAR], inside]).astype(np.float32)
    expected = at_rest(program, T)
    answers: dict[str, Any] = {"count": PAIRS, "temperatures": T, "expected": expected}
    if program.matrix is not None:
        turned = inputs(program, T, expected, np.broadcast_to(READING, expected.shape))
        answers |= {"reading": READING, "expected_input": turned}
        answers["input_tolerance"] = _ULPS * float(np.spacing(np.max(np.abs(turned))))
    largest = np.max(np.abs(expected))
    if program.remembers:
        step, recording = HOUR / PAIRS, warm_up((low, high))
        samples = np.interp(step * np.arange(PAIRS + 1), recording.t, recording["temperature"]).astype(np.float32)
        others = program.channels.items()
        channels = {channel: np.ones((PAIRS + 1, columns), dtype=np.float32) for channel, columns in others}
        dt = np.full(PAIRS + 1, step, dtype=np.float32)
        dt[0] = 0.0
        then = run(program, dt, {"temperature": samples, **channels})[1:]
        answers |= {"step": step, "warm_up": samples, "expected_then": then}
        largest = max(largest, np.max(np.abs(then)))
    return answers | {"tolerance": _ULPS * float(np.spacing(np.float32(largest)))}


def _names(program: Program) -> Iterator[tuple[effect.Signal, str]]:
    """Yield the signals of a program with the names of their variables."""
    count: Counter[str] = Counter()
    for node in program.nodes:
        if isinstance(node, effect.Reading):
            column = f"_{node.column}" if node.columns > 1 else ""
            yield node, f"in_{_word(node.channel)}{column}"
            continue
        name = _NAMES[type(node)]
        count[name] += 1
        yield node, f"{name}_{count[name]}"
