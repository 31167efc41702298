"""Whether gyros, accelerometers and magnetometers of a log have axes in common, by what they feel of the same turns.

Gyros carry a force, or a field, from one moment to another. Were their axes exchanged or reversed, G w being right for
w (a signed permutation G, of which there are 48), they would carry it elsewhere: that G is looked for with which both
fit best.

* Forces: of the pushes s_k (3,), felt between fixes and carried into the axes of one moment, and the changes of
  velocity less gravity y_k (3,) one attitude explains all but sum |y|^2 + sum |s|^2 - 2 (d1 + d2 + d3), d the singular
  values of sum y s', the least of them with the sign of its determinant (Wahba, SIAM Review 7 (3), 1965; Markley, J.
  Astronautical Sciences 36 (3), 1988). Without a receiver no change of velocity is reckoned with.
* Fields: m_1 - b = A (m_0 - b), A by the gyros, b the hard iron that fits all pairs best. A magnetometer that is
  reversed in all axes turns like one that is right.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.earth import STANDARD_GRAVITY
from nav.rotation import dcm_from_quat, quat_from_rotvec, quat_multiply, quat_normalise
from nav.samples import Array, ImuSamples, MagnetometerSample
from testbed.feeds.lateness import fixes
from testbed.feeds.log import Log

WINDOW_S, WINDOWS = 2.0, 5  # of a push, and so many after another for one attitude
STEP_S, LEAST_ANGLE = 0.5, 0.05  # between two fields, and what a vehicle turns by meanwhile, at least [s, rad]
MOST_STRETCHES, MOST_PAIRS = 40, 300  # those that turn most are taken
KNOWN_SHARE = 0.9  # of a window in which increments are known
# What 50 logs have (aeroplanes, copters, rovers): the axes that fit best leave up to 0.03 of sound forces, and others
# than its own fit no unit better by a factor of 1.9; of those whose axes were exchanged for this most leave 2 to 50
# times as much. Fields: 0.01 to 0.35, and no others fit one better, but one whose own axes leave 7 times as much.
LEAST_STRETCHES, MOST_FORCE_LEFT, FORCE_FACTOR = 8, 0.03, 2.0
LEAST_PAIRS, MOST_FIELD_LEFT, FIELD_FACTOR = 50, 0.4, 3.0
CLEARER = 1.5  # times what the best axes leave is left by the next, or no axes are named


def _rotations() -> Iterator[list[Array]]:
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            M = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(M) > 0:
                yield M


PROPER = np.array(sorted(_rotations(), key=lambda M: -np.trace(M)))  # (24, 3, 3), the first is none
SIGNS = (1.0, -1.0)  # of all rates: G is one of these times one of `PROPER`


class _Found(NamedTuple):
    """What gyros would have to be taken for, G (3, 3), to fit; whether no other axes nearly do."""

    G: Array
    clear: bool


def unlike(log: Log) -> dict[str, str]:
    """What speaks against those sensors of a log that can't have the axes they are taken to have, a sentence each."""
    t, v_n = _velocities(log)
    fields = {name: own for name, own in log.samples.items() if own and isinstance(own[0], MagnetometerSample)}
    told: dict[str, str] = {}
    for name, imu in log.imus.items():
        left = {sensor: _fields(imu, own) for sensor, own in fields.items()}
        turned = {sensor: _found(costs, FIELD_FACTOR, MOST_FIELD_LEFT) for sensor, costs in left.items()}
        gyros = _found(_forces(imu, t, v_n), FORCE_FACTOR, MOST_FORCE_LEFT)
        if gyros is not None:
            # A field that turns as they say speaks for them, and against the accelerometers.
            sound = any(own is not None and own[0, 0] <= MOST_FIELD_LEFT and not turned[s] for s, own in left.items())
            alike = any(found is not None and np.array_equal(found.G, gyros.G) for found in turned.values())
            axes = f"accelerometers{_as_vectors(gyros)}" if sound else f"gyros{_named(gyros.G, gyros.clear)}"
            axes += "" if sound or alike else ", or of its accelerometers"
            told[name] = f"{name}: its accelerometers feel other turns than its gyros: correct the axes of its {axes}"
        for sensor, found in turned.items():
            if found is not None and (gyros is None or not np.array_equal(found.G, gyros.G)):
                why = f"its field turns otherwise than the gyros of {name} say"
                advice = f"leave it out of the estimators' aids, or correct its axes{_as_vectors(found)}"
                told.setdefault(sensor, f"{sensor}: {why}: {advice}")
    return told


def _named(axes: Array, clear: bool) -> str:
    """Axes (3, 3) in the words of a table's columns, nothing where others might do."""
    if not clear:
        return ""
    x, y, z = (("" if row.sum() > 0 else "-") + "xyz"[int(np.abs(row).argmax())] for row in axes)
    return f' (by its turns ["{x}", "{y}", "{z}"] of what it is taken for)'


def _as_vectors(found: _Found) -> str:
    """Those of forces or fields instead: turned back. What reverses a turn is no axes of theirs."""
    return _named(found.G.T, found.clear and np.linalg.det(found.G) > 0)


def _velocities(log: Log) -> tuple[Array, Array]:
    """Times (N,) and velocities (N, 3) of the receiver; without one, of a vehicle that stays where it is."""
    if log.receiver is not None:
        t, v_n, _ = fixes(log.samples[log.receiver])
        known = np.isfinite(v_n).all(axis=1)
        if np.count_nonzero(known) > WINDOWS:
            return t[known], v_n[known]
    first, last = min(imu.t[0] for imu in log.imus.values()), max(imu.t[-1] for imu in log.imus.values())
    t = np.arange(first, last, WINDOW_S)
    return t, np.zeros((len(t), 3))


def _found(costs: Array | None, factor: float, most: float) -> _Found | None:
    """The axes that fit best by ``costs`` (2, 24) of signs and `PROPER`, if clearly better than none."""
    if costs is None or not costs.min() <= most or costs[0, 0] < factor * costs.min():
        return None
    sign, which = np.unravel_index(costs.argmin(), costs.shape)
    return _Found(SIGNS[sign] * PROPER[which], bool(np.sort(costs, axis=None)[1] > CLEARER * costs.min()))


def _forces(imu: ImuSamples, t: Array, v_n: Array) -> Array | None:
    """The share (2, 24) of pushes that no attitude explains, by signs and `PROPER`; None where too little turned."""
    marks = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], WINDOW_S)))
    t, v_n = t[marks], v_n[marks]
    windows = _Windows.of(imu, t)
    stretches = [
        k for k in range(0, len(t) - WINDOWS, WINDOWS)
        if windows.known[k : k + WINDOWS].all() and np.diff(t)[k : k + WINDOWS].max() < 2 * WINDOW_S
    ]  # fmt: skip
    if len(stretches) < LEAST_STRETCHES:
        return None
    stretches.sort(key=lambda k: -windows.angle[k : k + WINDOWS].sum())
    costs = np.zeros((len(SIGNS), len(PROPER)))
    taken = stretches[:MOST_STRETCHES]
    for k in taken:
        y = np.diff(v_n[k : k + WINDOWS + 1], axis=0)
        y[:, 2] -= STANDARD_GRAVITY * np.diff(t[k : k + WINDOWS + 1])
        for sign, costs_of in zip(SIGNS, costs, strict=True):
            C, pushes = np.eye(3), []
            for first, stop in itertools.pairwise(windows.rows[k : k + WINDOWS + 1]):
                C_1b, pushed = _carried(sign * imu.dtheta[first:stop], imu.dv[first:stop])
                pushes.append(np.einsum("ab,bcj->acj", C, pushed))
                C = C @ C_1b
            s = np.einsum("mia,mjb,kabj->mki", PROPER, PROPER, np.array(pushes))
            costs_of += _unexplained(s, y) / len(taken)
    return costs


def _unexplained(s: Array, y: Array) -> Array:
    """The share (M,) of vectors ``y`` (K, 3) and ``s`` (M, K, 3) that no rotation explains."""
    B = np.einsum("ki,mkj->mij", y, s)
    d = np.linalg.svd(B, compute_uv=False)
    explained = d[:, 0] + d[:, 1] + np.sign(np.linalg.det(B)) * d[:, 2]
    return np.asarray((np.sum(y**2) + np.sum(s**2, axis=(1, 2)) - 2 * explained) / np.sum(y**2))


def _fields(imu: ImuSamples, own: Sequence[Any]) -> Array | None:
    """The share (2, 24) of the changes of a field that turns leave, by signs and `PROPER`; None where too few turn."""
    t, field = np.array([one.t for one in own]), np.array([one.field_b for one in own])
    sound = np.isfinite(field).all(axis=1) & field.any(axis=1)
    t, field = t[sound], field[sound]
    if len(t) < LEAST_PAIRS:
        return None
    marks = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], STEP_S)))
    t, field = t[marks], field[marks]
    windows = _Windows.of(imu, t)
    pairs = np.flatnonzero(windows.known & (np.diff(t) < 2 * STEP_S) & (windows.angle > LEAST_ANGLE))
    pairs = pairs[np.argsort(-windows.angle[pairs])][:MOST_PAIRS]
    if len(pairs) < LEAST_PAIRS:
        return None
    before, after = field[pairs], field[pairs + 1]
    costs = np.zeros((len(SIGNS), len(PROPER)))
    for sign, costs_of in zip(SIGNS, costs, strict=True):
        rows = [slice(windows.rows[k], windows.rows[k + 1]) for k in pairs]
        A = np.array([_carried(sign * imu.dtheta[one], imu.dv[one])[0].T for one in rows])
        for which, M in enumerate(PROPER):
            turn = M @ A @ M.T
            left = after - np.einsum("kij,kj->ki", turn, before)
            of_iron = (np.eye(3) - turn).reshape(-1, 3)
            iron, *_ = np.linalg.lstsq(of_iron, left.reshape(-1), rcond=None)
            costs_of[which] = np.sum((left.reshape(-1) - of_iron @ iron) ** 2) / np.sum((after - before) ** 2)
    return costs


class _Windows(NamedTuple):
    """Between N + 1 times: rows of increments (N + 1,), what they turn by (N,) [rad], whether they are known (N,)."""

    rows: npt.NDArray[np.intp]
    angle: Array
    known: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, imu: ImuSamples, t: Array) -> _Windows:
        """Those of a unit between times ``t`` (N + 1,) [s]."""
        rows = np.searchsorted(imu.t, t + 1e-9)
        angle = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.nan_to_num(imu.dtheta), axis=1))])
        sound = np.isfinite(imu.dtheta + imu.dv).all(axis=1)
        lasts = np.concatenate([[0.0], np.cumsum(np.where(sound, imu.dt, 0.0))])
        known = np.diff(lasts[rows]) >= KNOWN_SHARE * np.diff(t)
        whole = np.diff(np.concatenate([[0], np.cumsum(sound)])[rows]) == np.diff(rows)
        return cls(rows, np.diff(angle[rows]), known & whole)


@njit
def _carried(dtheta: Array, dv: Array) -> tuple[Array, Array]:
    """C_0b (3, 3) after increments (N, 3), 0 the body axes before them, and the sum (3, 3, 3) of C_0b times each dv."""
    q, pushed = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((3, 3, 3))
    for k in range(len(dtheta)):
        half = dcm_from_quat(quat_normalise(quat_multiply(q, quat_from_rotvec(0.5 * dtheta[k]))))
        for a in range(3):
            for b in range(3):
                for j in range(3):
                    pushed[a, b, j] += half[a, b] * dv[k, j]
        q = quat_normalise(quat_multiply(q, quat_from_rotvec(dtheta[k])))
    return dcm_from_quat(q), pushed
