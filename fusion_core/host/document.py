"""A YAML file as plain values, and the line on which each of them was written.

A config needs little of YAML: mappings with text as keys, lists, text, numbers, true, false, null, and aliases. All
else is refused by its line: tags, keys that are no text, an alias within its own anchor, and what YAML reads as another
number than is written (1_000, 010, 1:30). Size, depth and the number of values, aliases counted in full, are bounded,
so that no text takes long.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from fusion_core.budget import check_regular
from fusion_core.errors import ConfigError, quote
from fusion_core.units.grammar import NUMBER

Location = tuple[str | int, ...]
Lines = dict[Location, tuple[Path, int]]

LARGEST = 1 << 18  # bytes of a file
DEEPEST = 32  # mappings and lists within one another
MAX_VALUES = 20_000  # values
_TAG = "tag:yaml.org,2002:"
_STRANGE = re.compile(r"[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_BREAK = re.compile(r"[\n\r\x85\u2028\u2029]")  # in a value, which stands on one line in all that names it
_TRUE, _FALSE = {"true", "yes", "on"}, {"false", "no", "off"}


def parse(path: Path, content: bytes | None = None) -> tuple[dict[str, Any], Lines]:
    """Read a file, or what is given in its place; then messages call it `path`.

    Returns
    -------
    The mapping, and file and line of every key and item by its location.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML or holds what a config does not.
    """
    node = _composed(path, _text(path, _content(path) if content is None else content))
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"{path}: is not a mapping of keys to values; write lines of `key: value`")
    reader = _Reader(path)
    return reader.mapping(node, ()), reader.lines


def _composed(path: Path, text: str) -> yaml.Node | None:
    """Return the nodes of a text, None where there are none; `path` is what an error calls it."""
    loader = _Loader(path, text)
    try:
        node: yaml.Node | None = loader.get_single_node()
    except ValueError:  # "\U00110000"
        raise ConfigError(f"{path}: has an escape in quotes that is no character; remove it") from None
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        reason = quote(problem or error, 120)
        raise ConfigError(f"{where}: is not YAML ({reason}); correct that line or the one above") from None
    finally:
        loader.dispose()
    return node


def _content(path: Path) -> bytes:
    try:
        check_regular(path)
        with path.open("rb") as file:
            return file.read(LARGEST + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{quote(path, 200)}: cannot be read ({reason}); name an existing YAML file") from None


def _text(path: Path, data: bytes) -> str:
    if len(data) > LARGEST:
        raise ConfigError(f"{path}: has more than {LARGEST // 1024} kB, a config has not; `driftlab init` writes one")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}:{line}: is not UTF-8 text; save it as UTF-8, or name another file") from None
    strange = _STRANGE.search(text)
    if strange:
        line, code = text.count("\n", 0, strange.start()) + 1, ord(strange[0])
        raise ConfigError(f"{path}:{line}: has the character U+{code:04X}, which no text has; remove it")
    return text


class _Loader(yaml.SafeLoader):
    """The composer of nodes, with a bound on depth and one on number."""

    def __init__(self, path: Path, text: str) -> None:
        super().__init__(text)
        self.path, self.depth, self.count = path, 0, 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one node and what is in it."""
        self.depth, self.count = self.depth + 1, self.count + 1
        line = self.peek_event().start_mark.line + 1  # type: ignore[no-untyped-call]
        if self.depth > DEEPEST:
            raise ConfigError(f"{self.path}:{line}: is more than {DEEPEST} levels deep; write a config with fewer")
        if self.count > MAX_VALUES:
            raise ConfigError(f"{self.path}:{line}: holds more than {MAX_VALUES} values; write a config with fewer")
        node: yaml.Node | None = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _Reader:
    """From nodes to values."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = path, 0
        self.lines: Lines = {}
        self.within: list[yaml.Node] = []  # where the reader is: node in node

    def mapping(self, node: yaml.MappingNode, at: Location) -> dict[str, Any]:
        """Read a mapping."""
        content: dict[str, Any] = {}
        known: dict[str, int] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise self._wrong(key_node, "a mapping or a list is a key", "write a name")
            key, line = key_node.value, key_node.start_mark.line + 1
            if key in known:
                raise self._wrong(
                    key_node, f"key '{quote(key)}' is written twice, on line {known[key]} and here", "remove one"
                )
            if key_node.style is None and key == "<<":
                raise self._wrong(key_node, "'<<' does not merge here", "use extends, or write the keys")
            self._check(key_node, at)
            known[key] = line
            self.lines[*at, key] = (self.path, line)
            content[key] = self.value(value_node, (*at, key))
        return content

    def value(self, node: yaml.Node, at: Location) -> Any:
        """Read any node."""
        self.count += 1
        if node in self.within:
            raise self._wrong(node, "an alias stands within its own anchor", "write the values out")
        if self.count > MAX_VALUES:
            raise self._wrong(node, f"with its aliases written out it holds more than {MAX_VALUES} values", "use fewer")
        if len(at) > DEEPEST:
            raise self._wrong(node, f"is more than {DEEPEST} levels deep", "write a config with fewer")
        self._check(node, at)
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node)
        self.within.append(node)
        result: Any
        if isinstance(node, yaml.MappingNode):
            result = self.mapping(node, at)
        else:
            result = []
            for k, item in enumerate(node.value):
                self.lines[*at, k] = (self.path, item.start_mark.line + 1)
                result.append(self.value(item, (*at, k)))
        self.within.pop()
        return result

    def _check(self, node: yaml.Node, at: Location) -> None:
        """Refuse a tag that is written out, and is not what the value is anyway, and a text that nobody can take.

        That is one with what an escape in quotes can write, and neither a path nor a terminal has; and one of several
        lines, as what names it would have them too.
        """
        scalar = {"str", "int", "float", "bool", "null", "timestamp", "merge", "value"}
        usual = scalar if isinstance(node, yaml.ScalarNode) else {"map", "seq"}
        if not node.tag.startswith(_TAG) or node.tag.removeprefix(_TAG) not in usual:
            raise self._wrong(node, f"has the tag '{quote(node.tag.replace(_TAG, '!!'))}'", "remove it")
        if isinstance(node, yaml.ScalarNode) and (strange := _STRANGE.search(node.value)):
            raise self._wrong(node, f"has the character U+{ord(strange[0]):04X}, which no text has", "remove it")
        if isinstance(node, yaml.ScalarNode) and _BREAK.search(node.value):
            where = f"{quote('.'.join(map(str, at)))}: " if at else ""
            raise self._wrong(node, f"{where}a text goes over several lines", "write it on one")

    def _scalar(self, node: yaml.ScalarNode) -> Any:
        text, kind = node.value, node.tag.removeprefix(_TAG)
        if kind == "null":
            return None
        if kind == "bool" and text.lower() in _TRUE | _FALSE:
            return text.lower() in _TRUE
        if kind == "int" and re.fullmatch(r"[+-]?(0|[1-9][0-9]{0,99})", text):
            return int(text)
        if kind == "float" and NUMBER.fullmatch(text) and abs(float(text)) < float("inf"):
            return float(text)
        if kind in {"bool", "int", "float"}:
            word = {"bool": "true or false", "int": "a plain integer", "float": "a plain, finite number"}[kind]
            raise self._wrong(node, f"'{quote(text)}' is not {word}", "write one, or quotes around a text")
        return text  # a date too

    def _wrong(self, node: yaml.Node, what: str, advice: str) -> ConfigError:
        return ConfigError(f"{self.path}:{node.start_mark.line + 1}: {what}; {advice}")


def parse_value(text: str, origin: Path) -> Any:
    """Read a value that stands alone; `origin` is what an error calls its place.

    Raises
    ------
    ConfigError
        If the text is not YAML or holds what a config does not.
    """
    node = _composed(origin, text)
    if node is None:
        raise ConfigError(f"{origin}: holds no value; write one, null to leave the key out")
    return _Reader(origin).value(node, ())
