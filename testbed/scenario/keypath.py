"""Key paths into a TOML document: how they are written, where they stand in the text, how one is set from outside.

A key path is a tuple of table keys (str) and list indexes (int): ``("sensors", "gnss", "denied", 1)``, written
``sensors.gnss.denied[1]``.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import PurePath
from typing import Any, TypeAlias

from testbed.errors import UserError, printable

KeyPath: TypeAlias = tuple[str | int, ...]

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_OVERRIDE_STEP = re.compile(
    r"""\[(?P<index>\d{1,9})\]|"(?P<basic>[^"]*)"|'(?P<literal>[^']*)'|(?P<bare>[^.\[\]"'=]+)"""
)
_TOKEN = re.compile(
    r"""(?P<skip>[ \t\r]+|\#[^\n]*)
      | (?P<newline>\n)
      | (?P<string>\"{3}(?:\\.|[^\\])*?\"{3,5} | '{3}.*?'{3,5} | "(?:\\.|[^"\\\n])*" | '[^'\n]*')
      | (?P<mark>[\[\]{},=.])
      | (?P<bare>[^\s\[\]{},=.\#"']+)""",
    re.DOTALL | re.VERBOSE,
)


def written(path: KeyPath) -> str:
    """A key path as a person writes it; keys that TOML wants quoted are quoted."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += ("." if text else "") + (step if _BARE_KEY.fullmatch(step) else f'"{printable(step)}"')
    return text


def read(text: str) -> KeyPath:
    """The key path that `written` wrote, of bare keys and indexes."""
    return tuple(int(index) if index else key for index, key in re.findall(r"\[(\d+)\]|([^.\[\]]+)", text))


def line_numbers(text: str) -> dict[KeyPath, int]:
    """Line on which each key, table and list item of a *valid* TOML document first stands.

    `tomllib` gives values without positions, and an error message without a line sends people searching.
    """
    return _Scanner(text).document()


class _Scanner:
    """Walks the tokens of a valid document; what the values are is not its business."""

    def __init__(self, text: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._tokens: list[tuple[str, str, int]] = []
        self._next = 0
        line = 1
        for match in _TOKEN.finditer(text):
            kind, token = str(match.lastgroup), match.group()
            if kind != "skip":
                self._tokens.append((kind, token, line))
            line += token.count("\n")
        self._tokens.append(("end", "", line))

    def document(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        arrays: dict[KeyPath, int] = {}
        while self._kind() != "end":
            if self._kind() == "newline":
                self._next += 1
            elif self._take("["):
                is_array = self._take("[")
                header, line = self._dotted_key(), self._line()
                table = ()
                for step in header[:-1]:
                    table = self._last_item((*table, step), arrays)
                table = (*table, header[-1])
                if is_array:
                    arrays[table] = arrays.get(table, -1) + 1
                table = self._last_item(table, arrays)
                self._note(table, line)
                self._next += 2 if is_array else 1
            else:
                self._pair(table)
        return self.lines

    @staticmethod
    def _last_item(path: KeyPath, arrays: dict[KeyPath, int]) -> KeyPath:
        return (*path, arrays[path]) if path in arrays else path

    def _kind(self) -> str:
        return self._tokens[self._next][0]

    def _line(self) -> int:
        return self._tokens[self._next][2]

    def _take(self, mark: str) -> bool:
        found = self._tokens[self._next][:2] == ("mark", mark)
        self._next += found
        return found

    def _note(self, path: KeyPath, line: int) -> None:
        for length in range(1, len(path) + 1):
            self.lines.setdefault(path[:length], line)

    def _dotted_key(self) -> KeyPath:
        keys: list[str] = []
        while True:
            kind, token, _ = self._tokens[self._next]
            keys.append(token if kind == "bare" else next(iter(tomllib.loads(f"{token}=0"))))
            self._next += 1
            if not self._take("."):
                return tuple(keys)

    def _pair(self, table: KeyPath) -> None:
        line = self._line()
        path = (*table, *self._dotted_key())
        self._note(path, line)
        self._take("=")
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        if self._take("["):
            index = 0
            while not self._take("]"):
                if self._kind() == "newline":
                    self._next += 1
                elif self._take(","):
                    index += 1
                else:
                    self._note((*path, index), self._line())
                    self._value((*path, index))
        elif self._take("{"):
            while not self._take("}"):
                if self._kind() == "newline" or self._take(","):
                    self._next += self._kind() == "newline"
                else:
                    self._pair(path)
        else:
            while self._kind() in ("bare", "string") or self._take("."):
                self._next += self._kind() in ("bare", "string")


def assign(data: dict[str, Any], override: str) -> KeyPath:
    """Set one ``key=value`` in a parsed document, in place; returns the path that was set.

    The key is dotted, with ``[2]`` or ``.2`` for list items and, for a list of tables, a table's own name:
    ``sensors.gnss.denied=[[300, 500]]``, ``plan[2].turns=3``, ``estimator.ins.aids=[]``. Missing tables are made. The
    value is read as TOML and, where that fails, taken as a string. Raises UserError that names the override.
    """
    key, equals, value = override.partition("=")
    where = f"--set {printable(override)}"
    if not equals:
        raise UserError(f"{where}: give it as key=value, such as sensors.gnss.rate_hz=10")
    steps = _override_steps(key.strip(), where)
    here: Any = data
    path: KeyPath = ()
    for step in steps[:-1]:
        slot = _slot(here, step, path, where)
        here = here.setdefault(slot, {}) if isinstance(here, dict) else here[slot]
        path = (*path, slot)
    slot = _slot(here, steps[-1], path, where)
    here[slot] = _toml_value(value.strip())
    return (*path, slot)


def override(key: str, value: Any) -> str:
    """The ``key=value`` that sets ``key`` to a value given in Python, as `assign` takes it. Raises as `as_toml`."""
    return f"{key}={as_toml(key, value)}"


def as_toml(key: str, value: Any) -> str:
    """A value given in Python for ``key``, as TOML has it.

    Booleans, numbers, texts, dates, lists and tables of these, and what `tolist` makes into such (numpy). Raises
    UserError for anything else.
    """
    return _toml_text(value, f"{printable(key)} = {printable(repr(value))}")


def _toml_text(value: Any, where: str) -> str:
    if hasattr(value, "tolist"):  # an array, or a number of numpy
        value = value.tolist()
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)
        case str() | PurePath():
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        case date():
            return value.isoformat()
        case Mapping():
            return (
                "{"
                + ", ".join(f"{_toml_text(str(key), where)} = {_toml_text(item, where)}" for key, item in value.items())
                + "}"
            )
        case Sequence():
            return "[" + ", ".join(_toml_text(item, where) for item in value) + "]"
    raise UserError(
        f"{where}: a scenario has booleans, numbers, texts, dates, lists and tables, and no {type(value).__name__}"
    )


def _override_steps(key: str, where: str) -> list[str]:
    steps, end = [], 0
    while match := _OVERRIDE_STEP.match(key, end):
        steps.append(next(group for group in match.groups() if group is not None).strip())
        end = match.end()
        if end == len(key) and all(steps):
            return steps
        end += key[end : end + 1] == "."
    raise UserError(f"{where}: can't read the key {key!r}: write it like sensors.gnss.rate_hz or plan[2].turns")


def _slot(here: Any, step: str, path: KeyPath, where: str) -> str | int:
    """The key or index by which ``step`` selects something inside ``here``."""
    if isinstance(here, dict):
        return step
    if not isinstance(here, list):
        raise UserError(f"{where}: {written(path)} is a single value and has nothing called {step} inside")
    if step.isascii() and step.isdigit():
        if int(step) < len(here):
            return int(step)
        has = f"has {len(here)} items, numbered from 0" if here else "is empty"
        raise UserError(f"{where}: there is no {written(path)}[{step}]: {written(path)} {has}")
    names = [item.get("name") if isinstance(item, dict) else None for item in here]
    if step in names:
        return names.index(step)
    known = ", ".join(str(name) for name in names if name is not None)
    choose = f"a number or one of {known}" if known else "a number"
    raise UserError(f"{where}: {written(path)} is a list: select {choose}, not {step}")


def _toml_value(text: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # not TOML, a number of thousands of digits, or brackets without end
        return text
    return parsed["value"] if parsed.keys() == {"value"} else text
