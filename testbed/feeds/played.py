"""The far end of a recorded run once more: it commands what was recorded, at the same times, and hears nothing."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nav.columns import Estimates
from nav.samples import Array
from testbed.errors import UserError
from testbed.feeds.feed import Surfaces, Turn
from testbed.feeds.piloted import TAKES_OVER, is_step

if TYPE_CHECKING:
    import xarray

SAME_TIME_S = 1e-6


class Played:
    """One that flies as it did (`testbed.feeds.bridged.FarEnd`). It fails as it did, or where its commands end.

    ``t`` (N,) [s] are the times of its steps, ``surfaces`` (N, 4) what it commanded where it ``flew`` (N,).
    """

    flies = True
    estimators: Collection[str] = ()

    def __init__(
        self,
        name: str,
        sensors: Mapping[str, str],
        failure: str,
        t: Array,
        flew: npt.NDArray[np.bool_],
        surfaces: Array,
    ) -> None:
        self.name, self.sensors, self.failure = name, sensors, ""
        self.surfaces: Surfaces | None = None
        self._t, self._flew, self._commands = t, flew, surfaces
        self._failure = failure or f"the recorded commands of {name} end here"

    def follow(self, turn: Turn) -> None:
        """Command what was commanded at the end of a turn."""
        if not is_step(turn):
            return
        now = float(turn.reference.t[-1]) + SAME_TIME_S
        last = int(np.searchsorted(self._t, now)) - 1
        if not len(self._t) or now > self._t[-1] + 2 * SAME_TIME_S:
            self.failure = self._failure
        elif last >= 0 and self._flew[last]:
            self.surfaces = Surfaces(*self._commands[last].tolist())

    def estimates(self, times: Sequence[float]) -> Mapping[str, Estimates]:
        """None: what it estimated is not heard again."""
        return {}

    def close(self) -> None:
        """Nothing is open."""


def played(record: xarray.DataTree) -> Played | None:
    """Who flew a recorded run; None where that was nobody from outside.

    Raises UserError when somebody did whose commands records of that time did not keep.
    """
    said = record.attrs.get("far_end")
    if said is None:
        events = _column(record, "events", "text")
        if any(str(text).endswith(TAKES_OVER.format("")) for text in events):
            raise UserError("was flown from outside, and kept no commands: it can't be repeated, only flown anew")
        return None
    try:
        one = json.loads(said)
        if not one["flies"]:
            return None
        name, failure, sensors = str(one["name"]), str(one["failure"]), dict(one["sensors"])
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"damaged record ({error}); run the scenario again") from None
    t, flies, surfaces = (_column(record, "far_end", key) for key in ("time", "flies", "surfaces"))
    return Played(name, sensors, failure, t, flies == 1, surfaces)


def _column(record: xarray.DataTree, group: str, name: str) -> npt.NDArray[Any]:
    """A column of a group, empty where there is none: a group is only there when there is something in it."""
    found = record.children.get(group)
    return np.zeros(0) if found is None else np.asarray(found.to_dataset(inherit=False)[name].values)
