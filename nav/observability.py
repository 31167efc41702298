"""Which error states can be seen: piece-wise constant systems (PWCS) and their singular values.

Over a segment i of constant F_i (n, n) [1/s] and H_i (m, n), with x' = F x and z = H x,

    Q_i = [H_i; H_i F_i; ...; H_i F_i^(n-1)]

holds the derivatives of the measurement. Over several segments, from the state at the start of the first,

    total      TOM = [Q_1; Q_2 e^(F_1 D_1); Q_3 e^(F_2 D_2) e^(F_1 D_1); ...]
    stripped   SOM = [Q_1; Q_2; Q_3; ...],  of the same null space where null(Q_i) lies in null(F_i) (`strippable`)

With Q = U S V', the singular value of the right vector in which a state dominates is how strongly it shows
(`Observability.degree`, relative to that of a reference state if one is given).

Singular values depend on units. `in_units` changes them, once and in the open: with the state in its prior 1-sigma,
the measurement in its noise and time in the interval between measurements, a value of 1 is an error that just shows.

Sources: Goshen-Meskin and Bar-Itzhack, IEEE Trans. AES 28 (1992) 1056; Cheng et al. 2020, Eq 15-21, which print the
discrete Phi where the continuous F belongs: e^Phi is no transition.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from nav.error_model import MOTION, Drive, ErrorModel, transition
from nav.rotation import dcm_from_quat
from nav.samples import Array

SEEN_SHARE = 0.9  # of a state that must lie in what is seen, to call it seen


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of constant ``F`` (n, n) [1/s] and ``H`` (m, n)."""

    F: Array
    H: Array
    duration_s: float


@dataclass(frozen=True, slots=True)
class Observability:
    """What an observability matrix (rows, n) says.

    ``rank`` counts the singular values above ``tolerance``. ``degree`` (n,) is each state's singular value, ``share``
    (n,) the part of the state that lies in the seen subspace: 1 seen alone, 1/2 seen only together with another of the
    same size, 0 not seen.
    """

    singular_values: Array
    rank: int
    degree: Array
    share: Array


def derivatives(segment: Segment) -> Array:
    """Q (n m, n) of one segment."""
    rows = [segment.H]
    for _ in range(len(segment.F) - 1):
        rows.append(rows[-1] @ segment.F)
    return np.vstack(rows)


def stripped(segments: Iterable[Segment]) -> Array:
    """SOM of the segments in their order."""
    return np.vstack([derivatives(segment) for segment in segments])


def total(segments: Iterable[Segment]) -> Array:
    """TOM of the segments in their order."""
    return np.vstack(list(_carried(segments)))


def _carried(segments: Iterable[Segment]) -> Iterable[Array]:
    """Q_i times the transition from the start of the first segment to that of segment i."""
    since_start = None
    for segment in segments:
        Q = derivatives(segment)
        yield Q if since_start is None else Q @ since_start
        step = expm(segment.F * segment.duration_s)
        since_start = step if since_start is None else step @ since_start


def strippable(segment: Segment, tolerance: float) -> bool:
    """Whether what the segment does not show stays as it is: null(Q) in null(F), both to ``tolerance``."""
    _, s, Vt = np.linalg.svd(derivatives(segment))
    hidden = Vt[int(np.sum(s > tolerance)) :]
    return bool(np.abs(segment.F @ hidden.T).max(initial=0.0) <= tolerance)


def in_units(segment: Segment, state: Array, measurement: Array, time_s: float) -> Segment:
    """The same segment with states counted in ``state`` (n,), measurements in ``measurement`` (m,), time in ``time_s``.

    F -> time D^-1 F D and H -> M^-1 H D, with D = diag(state), M = diag(measurement).
    """
    F = time_s * segment.F * state / state[:, None]
    H = segment.H * state / measurement[:, None]
    return Segment(F, H, segment.duration_s / time_s)


def analyse(Q: Array, tolerance: float, reference: int | None = None) -> Observability:
    """Singular values of an observability matrix ``Q`` (rows, n); ``tolerance`` is absolute, in the units of its rows.

    With a ``reference`` state the degrees are relative to its singular value (sigma_0 in Cheng et al., Eq 21).
    """
    _, s, Vt = np.linalg.svd(Q, full_matrices=len(Q) < Q.shape[1])
    s = np.concatenate([s, np.zeros(len(Vt) - len(s))])
    degree = s[np.argmax(np.abs(Vt), axis=0)]
    if reference is not None:
        degree = degree / degree[reference]
    rank = int(np.sum(s > tolerance))
    return Observability(s, rank, degree, np.sum(Vt[:rank] ** 2, axis=0))


def continuous(model: ErrorModel, q_nb: Array, v_n: Array, lla: Array, f_b: Array, omega_b: Array) -> Array:
    """F (n, n) [1/s] of the error model at one point: `error_model.transition` over one second, before its square.

    ``f_b`` [m/s^2] and ``omega_b`` [rad/s] are specific force and rate in b; the latter counts for scale factors only.
    """
    C_nb = dcm_from_quat(q_nb)
    F = np.diag(-model.decay_rate)
    FT = np.zeros((MOTION, model.mixing))
    sums = np.stack([C_nb, C_nb * omega_b, C_nb * f_b])
    transition(np.empty_like(FT), FT, model.driven, v_n, float(lla[0]), float(lla[2]), sums, 1.0)
    F[:MOTION, : model.mixing] = FT
    return F


def state_names(model: ErrorModel) -> list[str]:
    """One name for each state: block and axis."""
    axes = {name: ("north", "east", "down") for name in ("phi", "dv", "dp")}
    axes |= {block.name: ("x", "y", "z") for block in model.blocks if block.drive is not Drive.NONE and block.size == 3}
    numbers = tuple(str(k + 1) for k in range(max(block.size for block in model.blocks)))
    return [
        block.name if block.size == 1 else f"{block.name} {axes.get(block.name, numbers)[k]}"
        for block in model.blocks
        for k in range(block.size)
    ]


@dataclass(frozen=True, slots=True)
class Visibility:
    """Which states can be seen, and when: after each of N segments, from all up to it or from that one alone."""

    names: list[str]
    t: Array  # (N + 1,) edges of the segments [s]
    rank: Array  # (N,)
    degree: Array  # (N, n)
    share: Array  # (N, n)
    alone: Array  # (N, n) share of each state that the segment shows by itself

    def seen_from(self) -> Array:
        """(n,) end of the first segment after which the state is seen [s], infinite for never."""
        seen = self.share >= SEEN_SHARE
        return np.where(seen.any(axis=0), self.t[1:][np.argmax(seen, axis=0)], np.inf)

    def __str__(self) -> str:
        """A table: how the rank grows, then for each state since when it is seen, its share and its degree."""
        changes = np.flatnonzero(np.diff(self.rank, prepend=-1))
        steps = ", ".join(f"{self.rank[k]:.0f} after {self.t[k + 1]:.0f} s" for k in changes)
        width = max(len(name) for name in self.names)
        lines = [f"rank {steps}, of {len(self.names)}", f"{'state':{width}}  seen from [s]  share    degree"]
        for name, first, share, degree in zip(
            self.names, self.seen_from(), self.share[-1], self.degree[-1], strict=True
        ):
            when = f"{first:.0f}" if np.isfinite(first) else "never"
            lines.append(f"{name:{width}}  {when:>13}  {share:5.2f}  {degree:8.2g}")
        return "\n".join(lines)


def along(names: list[str], segments: Sequence[Segment], start_s: float, tolerance: float = 1.0) -> Visibility:
    """Rank, degree and share after each of the ``segments`` (in the units wanted), by the stripped matrix.

    The stripped matrix asks what the segments together can show of errors that stay as they are; carried back to the
    start, as in the total one, an hour of flight would be judged by how far errors grow in an hour.
    """
    R = np.zeros((0, len(names)))
    rank, degree, share, alone, edges = [], [], [], [], [start_s]
    for segment in segments:
        own = np.linalg.qr(derivatives(segment)).R  # same singular values and right vectors
        R = np.linalg.qr(np.vstack([R, own])).R
        found = analyse(R, tolerance)
        edges.append(edges[-1] + segment.duration_s)
        rank.append(found.rank)
        degree.append(found.degree)
        share.append(found.share)
        alone.append(analyse(own, tolerance).share)
    return Visibility(names, *map(np.array, (edges, rank, degree, share, alone)))


def visibility(
    names: list[str],
    t: Array,
    F: Array | Sequence[Array],
    measurements: Sequence[tuple[Array, Array]],
    prior: Array,
    time_s: float,
) -> Visibility:
    """Which states can be seen, and when, in N segments with edges ``t`` (N + 1,) [s].

    Each has its ``F`` (n, n) and one of the ``measurements``: H (m, n) and the 1-sigma of its noise (m,), m zero where
    nothing was measured. ``prior`` (n,) is the 1-sigma of the states, none of them zero; together with ``time_s`` [s],
    the time that a derivative is given to show, they set the units. A direction counts as seen when its singular value
    is more than 1: when an error as large as the prior moves the measurements by their noise. Each segment counts as
    one measurement; n equal ones are worth the root of n of them.
    """
    segments = [
        in_units(Segment(F_k, H, duration), prior, noise, time_s)
        for F_k, (H, noise), duration in zip(F, measurements, np.diff(t).tolist(), strict=True)
    ]
    return replace(along(names, segments, 0.0), t=t)


def flown(
    model: ErrorModel, t: Array, q_nb: Array, v_n: Array, lla: Array, f_b: Array, omega_b: Array,
    measurements: Sequence[tuple[Array, Array]], prior: Array, time_s: float,
) -> Visibility:  # fmt: skip
    """Which states of ``model`` can be seen, and when, along a flown trajectory: see `visibility`.

    The arrays of motion are those of the segments' middles: attitude (N, 4), velocity (N, 3), place (N, 3), specific
    force and rate in b (N, 3).
    """
    F = [continuous(model, *here) for here in zip(q_nb, v_n, lla, f_b, omega_b, strict=True)]
    return visibility(state_names(model), t, F, measurements, prior, time_s)
