"""The one exception that a user may see: a message, never a traceback; and the wording of what was mistaken."""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence

CHOICES_SHOWN = 16


class UserError(Exception):
    """A mistake in what the user gave: the message names the file, the key or the address, and what to do.

    The command line prints it and ends with exit code 2. Each argument is a line, in which is escaped what does not
    print: the name of a file may hold anything.
    """

    def __str__(self) -> str:
        return "\n".join(printable(str(line)) for line in self.args)

    def within(self, where: str) -> UserError:
        """The same mistake, found in something else, which is named first."""
        return UserError(f"{where}: {self.args[0]}", *self.args[1:])


def printable(text: str) -> str:
    """The same on one line: what does not print is escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def unknown(what: str, given: str, known: Sequence[str]) -> str:
    """That there is no such thing, and what there is."""
    return f"there is no {what} {shown(given)}: {choice(given, known)}"


def choice(given: str, known: Sequence[str]) -> str:
    """What to choose from, what is like the ``given`` first."""
    if not known:
        return "there is none to choose from"
    nearest = near(given, known)
    listed = (
        known if len(known) <= CHOICES_SHOWN else difflib.get_close_matches(given, known, n=CHOICES_SHOWN, cutoff=0)
    )
    more = ", …" if len(known) > CHOICES_SHOWN else ""
    return (f"did you mean {nearest[0]}? Choose from " if nearest else "choose from ") + ", ".join(listed) + more


def near(given: str, known: Sequence[str]) -> list[str]:
    """The one that was probably meant, if there is one."""
    return difflib.get_close_matches(given, known, n=1)


def shown(value: object) -> str:
    """A value as a scenario file would have it."""
    return short(repr(value) if isinstance(value, float) else json.dumps(value, default=str, ensure_ascii=False))


def short(text: str) -> str:
    """The beginning of a long text, on one line."""
    return printable(text if len(text) <= 60 else text[:57] + "...")
