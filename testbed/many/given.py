"""What is given to `testbed.campaign` and `testbed.check`, looked at before anything is made of it: anything may be."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

from testbed.errors import UserError, shown
from testbed.scenario import keypath


def require_path(what: str, given: Any, wanted: str) -> None:
    """Raises UserError where something is neither a path nor a text that may be one."""
    if not isinstance(given, str | Path) or given == "":
        raise UserError(f"{what}: give {wanted}, not {repr(given) if isinstance(given, str) else type(given).__name__}")


def whole(what: str, given: Any) -> int:
    """A whole number. Raises UserError where it is none."""
    if not isinstance(given, Integral) or isinstance(given, bool):
        raise UserError(f"{what}: give a whole number, not {_described(given)}")
    return int(given)


def crew(what: str, given: Any) -> int | str | None:
    """A number of workers, the address of a scheduler, or none of both. Raises UserError where it is nothing such."""
    if given is None or (isinstance(given, str) and not given.isdecimal()):
        return given
    count = whole(what, given)
    if count < 1:
        raise UserError(f"{what} {count}: give at least 1, or none for one a core")
    return count


def overrides(given: Any) -> Sequence[str]:
    """Overrides as ``key=value``, given so, or as a table. Raises UserError where they are neither."""
    if isinstance(given, Mapping):
        return [keypath.override(_key("overrides", key), value) for key, value in given.items()]
    if isinstance(given, Iterable) and not isinstance(given, str):
        listed = list(given)
        if all(isinstance(one, str) for one in listed):
            return listed
    wanted = 'give values by key, such as {"duration_s": 60}, or a list such as ["duration_s=60"]'
    raise UserError(f"campaign: overrides: {wanted}, not {_described(given)}")


def varied(given: Any) -> dict[str, Sequence[str]]:
    """The values of each key as ``--set`` takes them. Raises UserError where it has no list of them."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        wanted = 'give lists of values by key, such as {"sensors.gnss.latency_s": [0, 0.2]}'
        raise UserError(f"campaign: vary: {wanted}, not {_described(given)}")
    return {_key("vary", key): _listed(key, listed) for key, listed in given.items()}


def require_once(key: str, listed: Sequence[str]) -> None:
    """Raises UserError where there is no value to vary a key by, or one twice: 1 is 1.0, and 'a' is "a"."""
    pairs = itertools.combinations(map(_meant, listed), 2)
    if not listed or any(one == other and isinstance(one, bool) == isinstance(other, bool) for one, other in pairs):
        raise UserError(f"--vary {key}: give each value once, such as {key}=0,5,10")


def _meant(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        return value


def _listed(key: str, given: Any) -> Sequence[str]:
    listed = given.tolist() if hasattr(given, "tolist") else given  # an array of no dimensions holds one value
    if isinstance(listed, str) or not isinstance(listed, Iterable):
        raise UserError(f"vary {key}: {shown(str(given))} is one value: give a list of values, such as [0, 5]")
    return [one if isinstance(one, str) else keypath.as_toml(key, one) for one in listed]


def _key(what: str, given: Any) -> str:
    if not isinstance(given, str):
        raise UserError(f"campaign: {what}: a key is a text, not {_described(given)}")
    return given


def _described(given: Any) -> str:
    return shown(given) if isinstance(given, str | int | float) else type(given).__name__
