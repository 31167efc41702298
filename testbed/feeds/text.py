"""A table that is text: what parts its fields, which line names them, and its columns."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from testbed.errors import UserError

COMMENTS = ("#", "%")
MARKS = (";", "\t", ",")  # that part fields, the first that a row has; else spaces do
SPACES = " "
QUOTED = re.compile(r'"[^"]*"')
DECIMAL_COMMA, DECIMAL_POINT = re.compile(r"[-+]?\d*,\d+"), re.compile(r"[-+]?\d*\.\d+(e[-+]?\d+)?", re.IGNORECASE)
MOMENT = re.compile(r"\d{4}([-/])\d\d\1\d\d([T ]\d\d:\d\d\S*)?|\d\d:\d\d:\d\d(\.\d+)?")
UNITS = re.compile(
    r"[kmcuµn]?(s|sec|g|m|Pa|T|G|bar|[Gg]auss)|(rad|deg|°|k?m|cm|mm|ft|kn)(/(s|sec|hr?|min)|/s/s|/s\^?2|/s²)?"
    r"|[hm](Pa|bar)|dps|min|°C|%|-"
)
LIKE_MOMENT = re.compile(r"\d{1,4}([-./])\d{1,2}\1\d{1,4}(\D.*)?|\d{1,2}:\d\d(\D.*)?")  # as no column of numbers has it
SAID = re.compile(r"sep=.", re.IGNORECASE)  # a first line that tells spreadsheets the mark, which rows show as well
SHOWN = 100  # lines that show what numbers have for a point: in a few all may be whole
MISSING = ("", "NA", "N/A", "null")  # in place of numbers


class Layout(NamedTuple):
    """How a text is a table: the mark between its fields, or `SPACES`, and what its numbers have for a point.

    ``above`` lines come before that of the ``names``, or without these before the first row, which has ``width``
    fields. Names behind the mark of a comment, a field of its own, or with a line of units below, are ``hidden``.
    """

    mark: str
    decimal: str
    above: int
    names: list[str]
    width: int
    hidden: bool = False


def layout(lines: Iterable[str]) -> Layout:
    """How a text is to be read: its first line has the names, unless it is numbers, or a comment that has not as many.

    ``lines`` are at least those up to the second that is no comment; of numbers up to `SHOWN` are looked at.
    """
    comments: list[tuple[int, str]] = [(0, "")]  # those before the first other line, with their numbers
    plain: list[tuple[int, str]] = []  # the first of these
    for number, raw in enumerate(lines):
        line = raw.strip("\ufeff\r\n")
        if SAID.fullmatch(line) and not plain:
            continue
        if line.startswith(COMMENTS) and not plain:
            comments.append((number, line))
        elif line.strip():
            plain.append((number, line))
        if len(plain) == SHOWN:
            break
    if not plain:
        return Layout(",", ".", comments[-1][0], _fields(comments[-1][1], ","), 0)
    (number, first), (second, row) = plain[0], plain[:2][-1]
    mark = next((one for one in MARKS if one in QUOTED.sub("", row)), SPACES if " " in row.strip() else ",")
    fields = _fields(row, mark)
    shown = [one for _, line in plain[1:] or plain for one in _fields(line, mark)] if mark in ";\t" else []
    pointed = any(map(DECIMAL_POINT.fullmatch, shown))
    decimal = "," if not pointed and any(map(DECIMAL_COMMA.fullmatch, shown)) else "."
    width, top = len(fields), _fields(first, mark)
    if _are_units(fields) and len(top) == width and not _are_numbers(top, decimal):
        return Layout(mark, decimal, second, _each_once(top), width, hidden=True)
    first_names = not _are_numbers(top, decimal) and _are_numbers(fields, decimal)
    last, comment = comments[-1]
    above = _fields(comments[-2][1][1:], mark) if len(comments) > 2 else []
    units = _are_units(_fields(comment[1:], mark)) and len(above) == len(top) and not any(map(_is_number, above))
    comment = comments[-2][1] if units else comment
    for names, hidden in ((_fields(comment, mark), units), (_fields(comment[1:], mark), True)):
        if comment and len(names) == len(top) > 1 and not first_names:
            return Layout(mark, decimal, last, _each_once(names) if hidden else names, width, hidden)
    if _are_numbers(top, decimal):
        return Layout(mark, decimal, number, [], width)
    return Layout(mark, decimal, number, top, width)


def is_table(head: bytes) -> bool:
    """Whether a file begins as a text of columns does: with commas, with other marks in two rows alike, or numbers."""
    if any(byte < ord(" ") and byte not in b"\t\r\n" for byte in head):
        return False
    said = [line for line in head.decode(errors="replace").splitlines() if line.strip() and line[0] not in COMMENTS]
    lines = said[1:] if said and SAID.fullmatch(said[0].strip("\ufeff")) else said
    found = layout(lines)
    if b"," in head or not found.width:
        return b"," in head
    first, *rows = [_fields(line, found.mark) for line in lines[:3]]  # of which the second may have units
    marked = found.mark != SPACES or (rows and _are_units(rows[0]))
    alike = marked and any(len(row) == len(first) > 1 and any(map(_is_number, row)) for row in rows)
    return bool(alike) or _are_numbers([first, *rows][:2][-1], found.decimal)


def advice(field: str) -> str:
    """What to do about a field that is no number, behind a colon; empty where that is not known."""
    if LIKE_MOMENT.fullmatch(field.strip()):
        return (
            ": dates are read as ISO 8601 has them, 2015-03-07T12:04:10.5, and times of day beside a column of such"
            " dates, 2015-03-07: write them so, or give seconds as numbers"
        )
    if DECIMAL_COMMA.fullmatch(field.strip()):
        return ": decimal commas are read where semicolons or tabs part the fields, and none of these has a point"
    return ""


def columns(path: Path) -> Iterator[tuple[str, Any]]:
    """Name and values of each column of a text; those without names are numbered from 0.

    Raises UserError where rows have more fields than there are names, or the text is not in UTF-8.
    """
    import pandas

    with path.open(encoding="utf-8-sig", errors="replace") as file:
        found = layout(file)
    index: int | bool | None = False
    if found.names and found.mark == SPACES:
        index = None  # one field more than there are names is a name of the row, as R writes it
        if not 0 <= found.width - len(found.names) <= 1:
            told = f"names {len(found.names)} columns, and the row after it has {found.width} fields"
            raise UserError(f"{path}: line {found.above + 1} {told}: names with spaces need quotes, or other marks")
    elif found.names:
        index = 0 if _has_row_names(path, found) else False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pandas.errors.ParserWarning)  # of the empty fields at the ends of rows
            frame = pandas.read_csv(
                path,
                sep=r"\s+" if found.mark == SPACES else found.mark,
                decimal=found.decimal,
                skiprows=found.above + found.hidden,
                header=0 if found.names and not found.hidden else None,
                names=found.names if found.hidden else None,
                skipinitialspace=True,
                index_col=index,
                low_memory=False,
            )
    except UnicodeDecodeError:
        raise UserError(f"{path}: is text, but not in UTF-8: save it as that") from None
    names = [str(name) for name in frame.columns]
    return ((_free(str(name), names), frame[name].to_numpy()) for name in frame.columns)


def _free(name: str, names: list[str]) -> str:
    """A name without the blanks about it, unless another is called so."""
    return name if name.strip() in names else name.strip()


def _fields(line: str, mark: str) -> list[str]:
    """The fields of a line; what spaces part may be parted by several, or by tabs."""
    parts = re.sub(r"\s+", " ", line.strip()) if mark == SPACES else line
    return [one.strip() for one in next(csv.reader([parts], delimiter=mark, skipinitialspace=True), [])]


def _are_numbers(fields: list[str], decimal: str) -> bool:
    """Whether fields are a row of numbers, or times: no names, as the numbers of columns counted from 0 are."""
    given = [one for one in fields if one not in MISSING]
    counted = [str(k) for k in range(len(given))]
    return (
        bool(given)
        and given != counted
        and all(_is_number(one.replace(decimal, ".")) or MOMENT.fullmatch(one) for one in given)
    )


def _are_units(fields: list[str]) -> bool:
    given = [one.strip("[]()") for one in fields]
    return len(given) > 1 and all(map(UNITS.fullmatch, given)) and any(one != "-" for one in given)


def _each_once(names: list[str]) -> list[str]:
    """Names of which those that come again have a number, as pandas has them."""
    return [one if (k := names[:n].count(one)) == 0 else f"{one}.{k}" for n, one in enumerate(names)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _has_row_names(path: Path, found: Layout) -> bool:
    """Whether all rows have one field more than there are names: then the first has none, as R writes them.

    Raises UserError when only some have something after the last column: no telling which is which.
    """
    most = len(found.names)
    with path.open(encoding="utf-8", errors="replace") as file:
        if not any(line.count(found.mark) >= most for line in file):
            return False
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = csv.reader(file, delimiter=found.mark, skipinitialspace=True)
        more: dict[int, int] = {}  # by how many fields, the first line with something in one that has no name
        for fields in rows:
            if fields and rows.line_num > found.above + 1:
                more.setdefault(len(fields) if any(one.strip() for one in fields[most:]) else 0, rows.line_num)
    if set(more) == {most + 1}:
        return True
    for count, line in more.items():
        if count:
            raise UserError(f"{path}: line {line} has {count} fields, and the first, which names them, {most}")
    return False
