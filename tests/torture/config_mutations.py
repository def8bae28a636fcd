"""Mutations of a valid config: its quantities, its tree, its text, and the files that it extends."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Keys = tuple[Any, ...]
JUNK: tuple[Any, ...] = (
    None, True, False, 0, -1, 3, 2**70, 1e308, -1e308, 0.5, float("nan"), float("inf"), float("-inf"), "", " ", "x",
    "null", "0", "3", "1e5", "nan", "x" * 5000, [], [[]], {}, {"kind": "x"}, {"kind": None}, {"a": {"b": [1]}}, [None],
    "[bold]x[/bold]", "\u200b", "../../..", "a\nb", "é", "\U0001f600", 10**40, "%s", "{x}", b"\x00\xff", ["x", "y",
    "z"],
)  # fmt: skip


def quantities(number: str, unit: str, rng: np.random.Generator) -> str:
    """Return another text in the place of a quantity: some are quantities too."""
    a, b = rng.integers(1, 10, 2)
    x = float(rng.choice([1, 2.5, 1e-3, 40, 1e4])) * (float(number) or 1.0)
    texts = [
        f"{x!r} {unit}", f"{x:.3e} {unit}", f"+{x!r} {unit}", f"{x!r}  {unit}", f"{x!r}{unit}", f" {x!r} {unit} ",
        f"{a},{b}e-4 {unit}", f"{a},{b} {unit}", f"{a} 00{b} {unit}", f"{a}_000 {unit}", f"{a} .{b} {unit}",
        f"{a}. {b} {unit}",
        f"{a}..{b} {unit}", f"-{a}..{b} {unit}", f"{a} {unit} # {b}", f"{a}*{b} {unit}", f"{a}**{b} {unit}",
        f"({a}) {unit}",
        f"{a}+{b} {unit}", f"{a} - {b} {unit}", f"{a}/{b} {unit}", f"{a} {unit} + {b} {unit}", f"{a} {unit} {b}",
        f"{a} {b} {unit}",
        f"{a}e {unit}", f"e{a} {unit}", f"0x{a}F {unit}", f"{a}j {unit}", f"{a}e{b}e{a} {unit}", f"1e999 {unit}",
        f"-1e999 {unit}",
        f"nan {unit}", f"inf {unit}", f"1e-999 {unit}", f"{a}", unit, f"{a} {unit}/{unit}", f"{a} 1/({unit})",
        f"{a} ({unit})",
        f"{a} {unit}*{b}", f"{a} {unit}^{b}", f"{a} {b}{unit}", f"{a} {unit};", f"{a} {unit},", f"−{a} {unit}",
        f"{a} {unit}",
        f"٣ {unit}", f"{a}′ {unit}", f"½ {unit}", f"{a} % {unit}", f"{a} {unit.upper()}", f"{a} {unit} ± {b}",
        f"{a}+/-{b} {unit}",
        f"{a} {unit}\x00", f"{a}\n{unit}", f"{a}\t{unit}", f"{a:06d} {unit}", f"{a}.{b}.{a} {unit}", f"--{a} {unit}",
        f"-{a} {unit}",
        f"0 {unit}", f"-0.0 {unit}", f"{a} banana", f"{a} rad", f"{a} s", f"{a} deg/h", f"{a} m/s^2", f"{a} degC",
        f"{a} g", f"{a} Hz",
        f"1e300 {unit}", f"1e-300 {unit}", f"{a}e1{b} {unit}", f"{'9' * 400} {unit}", f"{a} [{unit}]",
        f"{a} {unit} {unit}",
        f"__import__('os') {unit}", f"{a} {unit}" * 40, "(" * 300 + str(a) + ")" * 300 + " " + unit,
    ]  # fmt: skip
    if rng.random() < 0.004:
        return f"9**9**9**9 {unit}"
    return str(texts[rng.integers(len(texts))])


def leaves(tree: Any, at: Keys = ()) -> list[tuple[Keys, Any]]:
    """Return the path and value of everything in a tree that is no container."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else None
    if items is None:
        return [(at, tree)]
    return [leaf for key, item in items for leaf in leaves(item, (*at, key))]


def places(tree: Any, at: Keys = ()) -> list[Keys]:
    """Return the path of everything in a tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [at, *(place for key, item in items for place in places(item, (*at, key)))]


def get(tree: Any, at: Keys) -> Any:
    """Return what is at a path."""
    for key in at:
        tree = tree[key]
    return tree


def put(tree: Any, at: Keys, value: Any) -> Any:
    """Return the tree with another value at a path."""
    if not at:
        return value
    get(tree, at[:-1])[at[-1]] = value
    return tree


QUANTITY = re.compile(r"\s*([-+\d.eE]+) (.+)")


def a_quantity(tree: Any, rng: np.random.Generator) -> Any:
    """Write another text in the place of a quantity, or of a unit."""
    found = [(at, m) for at, value in leaves(tree) if isinstance(value, str) and (m := QUANTITY.fullmatch(value))]
    units = [(at, value) for at, value in leaves(tree) if at[-1] == "unit" and isinstance(value, str)]
    if units and rng.random() < 0.15:
        at, unit = units[rng.integers(len(units))]
        text = quantities("1", unit, rng)
        return put(tree, at, text if rng.random() < 0.7 else text.removeprefix("1 ").lstrip("0123456789. "))
    at, m = found[rng.integers(len(found))]
    return put(tree, at, quantities(m[1], m[2], rng))


def _nested(depth: int) -> Any:
    tree: Any = "x"
    for k in range(depth):
        tree = [tree] if k % 2 else {"a": tree}
    return tree


def a_place(tree: Any, rng: np.random.Generator) -> Any:
    """Replace, remove, rename, add, wrap or swap something anywhere."""
    all_places = places(tree)[1:]
    at = all_places[rng.integers(len(all_places))]
    above, key, junk = get(tree, at[:-1]), at[-1], JUNK[rng.integers(len(JUNK))]
    match rng.integers(9):
        case 0 | 1:
            above[key] = copy.deepcopy(junk)
        case 2:
            del above[key]
        case 3 if isinstance(above, dict):
            above[_typo(str(key), rng)] = above.pop(key)
        case 4 if isinstance(above, dict):
            above[["kind", "unknown", "map", "path", "", "extends", "1", "é"][rng.integers(8)]] = copy.deepcopy(junk)
        case 5:
            above[key] = [above[key]] * int(rng.choice([1, 2, 3, 4, 300]))
        case 6:
            above[key] = {["kind", "value", key][rng.integers(3)]: above[key]}
        case 7:
            other = all_places[rng.integers(len(all_places))]
            above[key] = copy.deepcopy(get(tree, other))
        case _:
            above[key] = _nested(int(rng.choice([3, 30, 100])))
    return tree


def _typo(word: str, rng: np.random.Generator) -> str:
    k = int(rng.integers(max(len(word), 1)))
    return [word[:k] + word[k + 1 :], word + "_", word.upper(), word[:k] + "x" + word[k:]][rng.integers(4)]


INSERTS = (
    "&a ", "*a", "!!int abc", "!!float x", "!!python/object/apply:os.system [x]", "!!binary AAA", "!!set {a, b}",
    "!x y",
    "!!timestamp 2001-13-45", "2001-01-01", "? [a, b]\n: c\n", "? {a: b}\n: c\n", "<<: *a\n", "<<: {a: b}\n", "\t",
    "\n---\n",
    "\n...\n", "%YAML 9.9\n", "%TAG ! x\n", "|\n", ">\n  x\n", "'", '"', "[", "]", "{", "}", ":", "- ", "#", "\x00",
    "\x07",
    "\ufeff", "\u2028", "\x85", ".nan", ".inf", "-.inf", "0x10", "0o17", "1_000", "1:30", "~", "yes", "=", "12e03",
    "@", "`",
    "!!null x", "!!bool maybe", "!!str 3", "!!seq x", "!!map x", "!!merge <<", "&a [*a]", "&a {x: *a}", "!<tag:x> y",
    '"\\uD800"',
)  # fmt: skip


def a_text(text: str, rng: np.random.Generator) -> bytes:
    """Change the text or its bytes."""
    lines = text.splitlines(keepends=True)
    k, line = int(rng.integers(len(text))), int(rng.integers(len(lines)))
    insert = INSERTS[rng.integers(len(INSERTS))]
    match rng.integers(12):
        case 0:
            return text[:k].encode()
        case 1:
            return (text[:k] + insert + text[k:]).encode("utf-8", "surrogatepass")
        case 2:
            body = re.sub(r": (\S.*)?$", lambda m: f": {insert}{m[1] or ''}", lines[line].rstrip("\n"), count=1)
            return "".join([*lines[:line], body + "\n", *lines[line + 1 :]]).encode("utf-8", "surrogatepass")
        case 3:
            return re.sub(r"(: )\S[^{}\n]*", lambda m: m[1] + insert, text, count=1 + int(rng.integers(6))).encode()
        case 4:
            return "".join(lines[:line] + lines[line + 1 :]).encode()
        case 5:
            return "".join([*lines[: line + 1], lines[line], *lines[line + 1 :]]).encode()
        case 6:
            return "".join(
                [*lines[:line], "  " * int(rng.integers(1, 4)) + lines[line].lstrip(), *lines[line + 1 :]]
            ).encode()
        case 7:
            raw = bytearray(text.encode())
            for _ in range(int(rng.integers(1, 5))):
                raw[rng.integers(len(raw))] ^= 1 << int(rng.integers(8))
            return bytes(raw)
        case 8:
            return text.encode(["utf-16", "utf-16-le", "utf-32", "latin-1", "cp500", "utf-8-sig"][rng.integers(6)])
        case 9:
            return bytes(rng.integers(0, 256, int(rng.integers(0, 200)), dtype=np.uint8))
        case 10:
            i, j = sorted(rng.integers(len(text), size=2).tolist())
            return (text[:i] + text[j:]).encode()
        case _:
            return (text[:k] + text[k:].replace(" ", "\t", 1)).encode()


def _bomb(folder: Path, text: str, rng: np.random.Generator) -> str:
    levels = "\n".join(f"b{k + 1}: &b{k + 1} [{', '.join([f'*b{k}'] * 9)}]" for k in range(int(rng.choice([3, 5, 9]))))
    return f"b0: &b0 x\n{levels}\n{text}"


def _chain(folder: Path, text: str, rng: np.random.Generator) -> str:
    depth = int(rng.choice([3, 40, 1500]))
    for k in range(depth):
        (folder / f"e{k}.yaml").write_text(f"extends: e{k + 1}.yaml\n" if k < depth - 1 else text)
    return "extends: e0.yaml\n"


def _circle(folder: Path, text: str, rng: np.random.Generator) -> str:
    (folder / "e0.yaml").write_text("extends: config.yaml\n")
    return f"extends: {['e0.yaml', 'config.yaml', './config.yaml', '.'][rng.integers(4)]}\n{text}"


def _other(folder: Path, text: str, rng: np.random.Generator) -> str:
    names = ["mems_crs05", "mems_crs50", "[a, b]", "{a: b}", "3", "null", "true", "/dev/null", "..", "''", "x" * 5000,
    "!!int x",
             "'a\\0b'", '"a\\0b"', "/proc/self/mem", "recording.h5", "~/x", "2001-01-01"]  # fmt: skip
    return f"extends: {names[rng.integers(len(names))]}\n{text}"


def _deep(folder: Path, text: str, rng: np.random.Generator) -> str:
    depth = int(rng.choice([20, 200, 2000, 20_000]))
    opened = ["[", "{a: ", "- "][rng.integers(3)]
    return f"{text}\nx: " + ("\n" if opened == "- " else "") + opened * depth


def _cycle(folder: Path, text: str, rng: np.random.Generator) -> str:
    return str(
        [f"&a\nz: *a\n{text}", f"{text}\nz: &a {{b: *a}}\n", f"{text}\nz: &a [*a]\n", f"{text}\nz: *nowhere\n"][
            rng.integers(4)
        ]
    )


FILES: tuple[Callable[[Path, str, np.random.Generator], str], ...] = (_chain, _circle, _other, _other, _deep, _cycle)


def mutate(base: dict[str, Any], rng: np.random.Generator, folder: Path) -> bytes:
    """Return another config, the files beside it written into the folder."""
    how, tree = rng.random(), copy.deepcopy(base)
    if how < 0.42:
        tree = a_quantity(tree, rng)
    elif how < 0.7:
        for _ in range(int(rng.choice([1, 1, 2]))):
            tree = a_place(tree, rng) if isinstance(tree, dict) and tree else tree
    if how < 0.7:
        flow = [None, True, False][rng.integers(3)]
        return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, default_flow_style=flow).encode(
            "utf-8", "surrogatepass"
        )
    text = yaml.safe_dump(base, sort_keys=False)
    if how < 0.95:
        return a_text(text, rng)
    if how < 0.953:
        return _bomb(folder, text, rng).encode()
    return FILES[rng.integers(len(FILES))](folder, text, rng).encode()
