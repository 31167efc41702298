"""Samples, estimates and reports as columns: many at once, from what made them to the record.

All are sequences of the single ones (`nav.samples`), for whoever looks at few of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain, groupby
from typing import Any, TypeAlias, overload

import numpy as np
import numpy.typing as npt

from nav.samples import Array, Estimate, Outcome, Sample, Status, UpdateReport

MANY = 8  # samples from which on columns take less time than one by one


@dataclass(frozen=True, slots=True)
class Samples(Sequence[Sample]):
    """Samples of one sensor one after the other: the fields of a ``kind`` of sample, with a row for each of N.

    ``columns`` are in the order of the fields, the sensor being the last. A single one is made when it is asked for.
    """

    kind: type[Any]
    sensor: str
    columns: Mapping[str, npt.NDArray[Any]]

    @property
    def t(self) -> Array:
        """When each was true (N,) [s]."""
        return self.columns["t"]

    @property
    def t_arrival(self) -> Array:
        """When each could first have been known (N,) [s]."""
        return self.columns["t_arrival"]

    def __len__(self) -> int:
        return len(self.t)

    def __iter__(self) -> Iterator[Sample]:
        for row in zip(*(x.tolist() if x.ndim == 1 else x for x in self.columns.values()), strict=True):
            yield self.kind(*row, self.sensor)

    @overload
    def __getitem__(self, which: int) -> Sample: ...
    @overload
    def __getitem__(self, which: slice | npt.NDArray[np.bool_]) -> Samples: ...

    def __getitem__(self, which: int | slice | npt.NDArray[np.bool_]) -> Sample | Samples:
        """One of them, or those of a slice or a mask."""
        if isinstance(which, slice | np.ndarray):
            return Samples(self.kind, self.sensor, {name: x[which] for name, x in self.columns.items()})
        row = (x.item(which) if x.ndim == 1 else x[which] for x in self.columns.values())
        one: Sample = self.kind(*row, self.sensor)
        return one


def delivered(kind: type[Any], sensor: str, t: Array, latency: float, **columns: npt.NDArray[Any]) -> Sequence[Sample]:
    """What a sensor measured at ``t`` (N,) [s] and tells ``latency`` [s] later: few samples one by one."""
    samples = Samples(kind, sensor, {"t": t, "t_arrival": t + latency, **columns})
    return samples if len(t) >= MANY else [*samples]


def one_by_one(samples: Iterable[Sample | Samples]) -> Iterator[Sample]:
    """All of them as single ones."""
    for one in samples:
        yield from one if isinstance(one, Samples) else (one,)


def chosen(samples: Sequence[Any], which: npt.NDArray[np.bool_]) -> Sequence[Any]:
    """Those of N samples of one sensor that a mask (N,) has."""
    if isinstance(samples, Samples):
        return samples[which]
    return [one for one, wanted in zip(samples, which.tolist(), strict=True) if wanted]


def column(samples: Sequence[Any], name: str) -> npt.NDArray[Any]:
    """One field of N samples of one sensor, a row of each."""
    return samples.columns[name] if isinstance(samples, Samples) else np.array([getattr(one, name) for one in samples])


@dataclass(frozen=True, slots=True)
class FusedReports(Sequence[UpdateReport]):
    """Reports on N parts of samples that were simply fused, one after the other.

    ``kinds`` are sensor, aid and axes m; ``kind`` (N,) the place of each report's among them. ``innovation`` (N, 3) and
    ``S`` (N, 9), row by row, begin with the m and the m * m numbers that there are; the others as in `UpdateReport`.
    """

    kinds: Sequence[tuple[str, str, int]]
    kind: npt.NDArray[np.int64]
    t: Array
    innovation: Array
    S: Array
    nis: Array
    threshold: Array

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, which: int) -> UpdateReport: ...
    @overload
    def __getitem__(self, which: slice) -> list[UpdateReport]: ...

    def __getitem__(self, which: int | slice) -> UpdateReport | list[UpdateReport]:
        """One of them, or those of a slice."""
        rows = range(len(self))[which]
        return self._one(rows) if isinstance(rows, int) else [self._one(k) for k in rows]

    def _one(self, k: int) -> UpdateReport:
        sensor, aid, m = self.kinds[self.kind[k]]
        numbers = float(self.nis[k]), float(self.threshold[k])
        S = self.S[k, : m * m].reshape(m, m)
        return UpdateReport(float(self.t[k]), sensor, aid, self.innovation[k, :m], S, *numbers, 1.0, Outcome.FUSED)

    def part(self, first: int, last: int) -> FusedReports:
        """Those from the first to before the last, as columns."""
        own = slice(first, last)
        return FusedReports(
            self.kinds, self.kind[own], self.t[own], self.innovation[own], self.S[own], self.nis[own],
            self.threshold[own],
        )  # fmt: skip

    def by_kind(self) -> Iterator[FusedReports]:
        """Those of one kind after the other, as columns of as many numbers as it has."""
        for number, (sensor, aid, m) in enumerate(self.kinds):
            own = np.flatnonzero(self.kind == number)
            if len(own):
                yield FusedReports(
                    [(sensor, aid, m)], np.zeros(len(own), np.int64), self.t[own], self.innovation[own, :m],
                    self.S[own, : m * m], self.nis[own], self.threshold[own],
                )  # fmt: skip


class Reports(Sequence[UpdateReport]):
    """Reports one after the other: single ones, and stretches of `FusedReports`."""

    def __init__(self, pieces: Iterable[UpdateReport | FusedReports] = ()) -> None:
        self.pieces = [*pieces]

    @classmethod
    def joined(cls, several: Iterable[Reports]) -> Reports:
        """Those of several, in as few stretches as can be."""
        pieces: Reported = []
        for fused, run in groupby((piece for one in several for piece in one.pieces), _kinds):
            own = [*run]
            pieces += own if fused is None or len(own) == 1 else [_stretch(own)]
        return cls(pieces)

    def __len__(self) -> int:
        return sum(len(piece) if isinstance(piece, FusedReports) else 1 for piece in self.pieces)

    def __iter__(self) -> Iterator[UpdateReport]:
        for piece in self.pieces:
            if isinstance(piece, FusedReports):
                yield from piece[:]
            else:
                yield piece

    @overload
    def __getitem__(self, which: int) -> UpdateReport: ...
    @overload
    def __getitem__(self, which: slice) -> list[UpdateReport]: ...

    def __getitem__(self, which: int | slice) -> UpdateReport | list[UpdateReport]:
        """One of them, or those of a slice."""
        return [*self][which]

    def of(self, sensor: str, aid: str) -> Iterator[UpdateReport]:
        """Those on one part of the samples of one sensor."""
        for piece in self.pieces:
            if isinstance(piece, FusedReports):
                for number, (of, part, _) in enumerate(piece.kinds):
                    if (of, part) == (sensor, aid):
                        yield from (piece[k] for k in np.flatnonzero(piece.kind == number).tolist())
            elif (piece.sensor, piece.aid) == (sensor, aid):
                yield piece


def _kinds(piece: UpdateReport | FusedReports) -> int | None:
    """What stretches that can be joined have in common."""
    return id(piece.kinds) if isinstance(piece, FusedReports) else None


def _stretch(pieces: Sequence[Any]) -> FusedReports:
    """Stretches of the same kinds as one."""
    columns = ("kind", "t", "innovation", "S", "nis", "threshold")
    return FusedReports(pieces[0].kinds, *(np.concatenate([getattr(one, name) for one in pieces]) for name in columns))


# The fields of an estimate that are arrays, and how long they are.
VECTORS: Mapping[str, tuple[int, ...]] = {
    "v_n": (3,), "q_nb": (4,), "gyro_bias": (3,), "accel_bias": (3,), "covariance": (9, 9), "sigma_gyro_bias": (3,),
    "sigma_accel_bias": (3,),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Estimates(Sequence[Estimate]):
    """Estimates one after the other: the fields of `Estimate`, with a row of each array for each of N.

    ``status`` (N,) are numbers of `Status`. In ``extra`` a state that an estimate lacks is NaN, and so is its sigma.
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    sigma_gyro_bias: Array
    sigma_accel_bias: Array
    status: npt.NDArray[np.int64]
    extra: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @classmethod
    def of(cls, pieces: Iterable[Estimate | Estimates]) -> Estimates:
        """Single ones, and several at once, in their order."""
        blocks: list[Estimates] = []
        singles: list[Estimate] = []
        for piece in pieces:
            if isinstance(piece, Estimate):
                singles.append(piece)
                continue
            if singles:
                blocks.append(cls._gathered(singles))
                singles = []
            blocks.append(piece)
        if singles:
            blocks.append(cls._gathered(singles))
        if len(blocks) < 2:
            return blocks[0] if blocks else NO_ESTIMATES
        columns = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in (*_NUMBERS, *VECTORS)}
        return cls(**columns, extra=_joined(blocks))

    @classmethod
    def _gathered(cls, singles: Sequence[Estimate]) -> Estimates:
        columns: dict[str, Any] = {name: np.array([getattr(one, name) for one in singles]) for name in _NUMBERS}
        columns |= {
            name: np.array([getattr(one, name) for one in singles], float).reshape(-1, *shape)
            for name, shape in VECTORS.items()
        }
        widths = {name: len(value) for one in singles for name, (value, _) in one.extra.items()}
        extra = {}
        for name, width in widths.items():
            unknown = (np.full(width, np.nan),) * 2
            pairs = np.array([one.extra.get(name, unknown) for one in singles], float)
            extra[name] = pairs[:, 0], pairs[:, 1]
        return cls(**columns, extra=extra)

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, which: int) -> Estimate: ...
    @overload
    def __getitem__(self, which: slice | Sequence[int]) -> Estimates: ...

    def __getitem__(self, which: int | slice | Sequence[int]) -> Estimate | Estimates:
        """One of them, or those of a slice or of a list of indices."""
        if not isinstance(which, int):
            rows = which if isinstance(which, slice) else np.asarray(which, int)  # once for all columns
            columns = {name: getattr(self, name)[rows] for name in (*_NUMBERS, *VECTORS)}
            return Estimates(**columns, extra={name: (x[rows], s[rows]) for name, (x, s) in self.extra.items()})
        k = range(len(self))[which]
        extra = {name: (x[k], sigma[k]) for name, (x, sigma) in self.extra.items()}
        for name, (x, sigma) in self.extra.items():
            if math.isnan(x[k, 0]) and np.isnan((x[k], sigma[k])).all():
                del extra[name]
        return Estimate(
            float(self.t[k]), float(self.lat[k]), float(self.lon[k]), float(self.h[k]), self.v_n[k], self.q_nb[k],
            self.gyro_bias[k], self.accel_bias[k], self.covariance[k], self.sigma_gyro_bias[k],
            self.sigma_accel_bias[k], _status(int(self.status[k])), extra,
        )  # fmt: skip


@cache
def _status(number: int) -> Status:
    """A status by its number: made anew it takes as long as all the rest."""
    return Status(number)


Estimated: TypeAlias = list[Estimate | Estimates]  # on the way, one at a time or several
Reported: TypeAlias = list[UpdateReport | FusedReports]
_NUMBERS = ("t", "lat", "lon", "h", "status")
_EMPTY: dict[str, Any] = dict.fromkeys(("t", "lat", "lon", "h"), np.empty(0)) | {
    name: np.empty((0, *shape)) for name, shape in VECTORS.items()
}
NO_ESTIMATES = Estimates(**_EMPTY, status=np.empty(0, np.int64))


def _joined(blocks: Sequence[Estimates]) -> dict[str, tuple[Array, Array]]:
    """The further states of blocks; where one lacks a state it is NaN."""
    extra = {}
    for name in dict.fromkeys(chain.from_iterable(block.extra for block in blocks)):
        width = next(block.extra[name][0].shape[1] for block in blocks if name in block.extra)
        pairs = [block.extra.get(name) or (np.full((len(block), width), np.nan),) * 2 for block in blocks]
        extra[name] = np.concatenate([x for x, _ in pairs]), np.concatenate([sigma for _, sigma in pairs])
    return extra
