"""Steps as the rows of numbers that a kernel takes (`nav.batch`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from nav.aids.base import PlainAid
from nav.columns import chosen, column
from nav.error_model import Indices
from nav.increments import ADVANCE, ESTIMATE, HORIZON, NUMBERS, TIME, WHAT, Steps
from nav.samples import Array, GnssSample, has_fix

SPLIT = -3  # of a step, in place of the number of an aid: it only ends an increment
WIDTH = NUMBERS + 12
ANY, OTHERWISE = -1, -2  # in place of an aid: no sample, and one that is not plain
NONE = np.empty(0, np.int64)


class Plan(NamedTuple):
    """All steps (N, WIDTH) as `follow` takes them; the rows of their aids in the tables (N,), or `ANY`, `OTHERWISE`;
    which of them are fixes of which receiver, and which are samples of each sensor, ascending.
    """

    rows: Array
    aid: Indices
    fixes: list[tuple[int, str]]
    of: dict[str, Indices]

    def own(self, sensor: str, first: int, stop: int) -> Indices:
        """Which of the steps from ``first`` to before ``stop`` are samples of a sensor."""
        own = self.of.get(sensor, NONE)
        return own[np.searchsorted(own, first) : np.searchsorted(own, stop)]


def planned(steps: Steps, aids: Mapping[str, tuple[int, PlainAid]]) -> Plan:
    """All ``steps`` as rows for `nav.batch.follow`, with the ``aids`` that are plain and their rows in its tables."""
    t, horizon = np.array(steps.t), np.array(steps.horizon)
    rows, aid = np.zeros((len(t), WIDTH)), np.full(len(t), ANY)
    rows[:, TIME], rows[:, HORIZON], rows[:, WHAT] = t, horizon, np.where(np.isnan(t), ADVANCE, ESTIMATE)
    of: dict[str, list[Indices]] = {}
    fixes: list[tuple[int, str]] = []
    for sensor, places, samples in steps.groups:
        where = np.asarray(places)
        of.setdefault(sensor, []).append(where)
        if sensor not in aids:
            aid[where] = OTHERWISE
            continue
        row, aid_of = aids[sensor]
        telling = t[where] == horizon[where]  # not too late, nor not known when
        aid[where] = np.where(telling, row, OTHERWISE)
        rows[where, WHAT] = SPLIT
        are_fixes = isinstance(samples[0], GnssSample)
        if are_fixes:
            telling &= np.array(has_fix(column(samples, "fix_type")), bool)
        if not telling.any():
            continue
        if not telling.all():
            samples, where = chosen(samples, telling), where[telling]
        numbers = aid_of.numbers(samples)
        rows[where, NUMBERS : NUMBERS + numbers.shape[1]] = numbers
        rows[where, WHAT] = row
        if are_fixes:
            fixes += [(k, sensor) for k in where.tolist()]
    return Plan(
        rows, aid, sorted(fixes),
        {sensor: own[0] if len(own) == 1 else np.sort(np.concatenate(own)) for sensor, own in of.items()},
    )  # fmt: skip
