"""Looking back: what a filter would have estimated had it known the whole run.

Fixed-interval smoothing in the form of Bryson and Frazier (Bierman, Fixed interval smoothing with discrete
measurements, International Journal of Control 18 (1), 1973), which equals that of Rauch, Tung and Striebel and inverts
no covariance. From the last measurement back, with T of each step of time and the gain K of each update,

    lambda <- T' lambda                                 Lambda <- T' Lambda T
    lambda <- (I - K H)' lambda - H' S^-1 nu            Lambda <- (I - K H)' Lambda (I - K H) + H' S^-1 H

and at any time x_smoothed = x - P lambda, P_smoothed = P - P Lambda P, of estimate and covariance as they were then.
All that happens between two nodes is one such map, lambda <- M lambda + m and Lambda <- M Lambda M' + N, and is
multiplied up as it happens. So only nodes are kept; between them the smoothed state is carried by the strapdown.

Where a filter gives up what it knew (`nav.reference.forget`), the past is smoothed as if it had been unsure by then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from nav._jit import njit
from nav.error_model import MOTION, ErrorModel, Indices, sensor_errors, take_errors, transition
from nav.samples import Array, ImuSamples, usable
from nav.state import State, inject, integrate
from nav.strapdown import step

NOTHING = 1e-6  # two times this close are the same [s]
PIECE = 25  # increments that are taken in at once
LEAST = 1e-3  # of a variance, that is left by what comes later
NODE_S = 1.0  # between nodes; within it the noise of any IMU moves the state by far less than its smoothed sigma


class Smoothed(NamedTuple):
    """A smoothed state at ``t`` [s]: a `State` of one filter, whose P is that of the node before it."""

    t: float
    state: State


class _Node(NamedTuple):
    """The filter at ``t``, and the map (M, m, N) from the next node back to here, filled as it goes on."""

    t: float
    state: State
    M: Array
    m: Array
    N: Array


class Smoother:
    """Keeps what one closed filter of a ``model`` does, and looks back in the end (`states`).

    The filter tells it of each block of increments before it takes it (`carry`), of each update that it makes
    (`updated`), of each time at which it has used its samples (`pause`), and of each at which it starts (`begin`).
    """

    def __init__(self, model: ErrorModel) -> None:
        self._model = model
        self._nodes: list[_Node] = []
        self._blocks: list[ImuSamples] = []
        self._waiting: list[ImuSamples] = []  # since the last update, from this state on
        self._from: State | None = None

    def begin(self, t: float, state: State) -> None:
        """The filter starts at ``t`` [s]: what comes after tells nothing of what was before."""
        self._catch_up()
        if self._nodes:
            self._nodes[-1].M[:] = 0.0
        self._add(t, state)

    def carry(self, state: State, imu: ImuSamples) -> None:
        """The filter is about to go on from ``state`` by a block of increments."""
        if not self._nodes:
            return
        sound = _sound(imu, state.rates)
        self._blocks.append(sound)
        if self._from is None:
            self._from = state.copy()
        self._waiting.append(sound)

    def _catch_up(self) -> None:
        """Take in the increments since the last update, in pieces that no edge of a block changes by a bit."""
        start, model = self._from, self._model
        if start is None:
            return
        imu, common = _joined(self._waiting), len(start.imu)
        self._waiting, self._from = [], None
        for first in range(0, len(imu), PIECE):
            piece = slice(first, first + PIECE)
            Phi = np.zeros((MOTION, common))
            T = _transition(
                Phi, start.q_nb, start.v_n, start.lla, start.errors, start.imu, model.driven,
                imu.dtheta[piece], imu.dv[piece], imu.dt[piece],
            )  # fmt: skip
            M = self._nodes[-1].M
            moved = M[:, :common] @ Phi.T
            decay = np.exp(-T * model.decay_rate)
            M *= decay
            M[:, :MOTION] = moved
            start.imu[MOTION:] *= decay[MOTION:common]
            sensor_errors(start.errors, start.imu, model.driven)

    def updated(self, P: Array, H: Array, nu: Array, S: Array) -> None:
        """The filter has used an innovation ``nu`` (m,) of covariance ``S``, its own having been ``P`` (n, n)."""
        if not self._nodes:
            return
        self._catch_up()
        _, _, M, m, N = self._nodes[-1]
        MH = M @ H.T
        weighed = np.linalg.solve(S, MH.T).T  # M H' S^-1
        m -= weighed @ nu
        N += weighed @ MH.T
        M -= MH @ np.linalg.solve(S, H @ P)

    def pause(self, t: float, state: State) -> None:
        """The filter is at ``t`` [s] and settled: a node, if the last one is `NODE_S` ago."""
        if not self._nodes or t - self._nodes[-1].t >= NODE_S:
            self._catch_up()
            self._add(t, state)

    def _add(self, t: float, state: State) -> None:
        n = self._model.size
        self._nodes.append(_Node(t, state.copy(), np.eye(n), np.zeros(n), np.zeros((n, n))))

    def states(self, times: Sequence[float]) -> Iterator[Smoothed]:
        """The smoothed states at ``times`` [s], ascending; none before the filter's start or after its own time."""
        self._catch_up()
        nodes = self._look_back()
        if not nodes:
            return
        imu = _joined(self._blocks)
        starts = np.array([t for t, _ in nodes])
        own, at, end = -1, nodes[0], max([nodes[-1].t, *imu.t[-1:]])
        for t in times:
            node = int(np.searchsorted(starts, t + NOTHING)) - 1
            if node < 0 or t > end + NOTHING:
                continue
            if node != own:
                own, at = node, nodes[node]
                now = Smoothed(at.t, at.state.copy())
            now, state = self._carried(now, t, imu)
            yield Smoothed(t, state)

    def _carried(self, now: Smoothed, t: float, imu: ImuSamples) -> tuple[Smoothed, State]:
        """A smoothed state taken on by the whole increments up to ``t``, and by the part of the next that is needed.

        So it makes no difference at which other times one looks.
        """
        state, begun = now.state.copy(), now.t
        first, last = (int(np.searchsorted(imu.t, at + NOTHING)) for at in (now.t, t))
        for k in range(first, last):
            self._advance(state, imu, k, float(imu.t[k]) - begun)
            begun = float(imu.t[k])
        whole = Smoothed(begun, state)
        if last < len(imu) and t - begun > NOTHING:
            state = state.copy()
            self._advance(state, imu, last, t - begun)
        return whole, state

    def _advance(self, state: State, imu: ImuSamples, k: int, dt: float) -> None:
        rates = np.array([imu.dtheta[k], imu.dv[k]]) / imu.dt[k]
        _advance(state.q_nb, state.v_n, state.lla, state.errors, state.imu, self._model.driven, rates, dt)

    def _look_back(self) -> list[Smoothed]:
        """The smoothed nodes, in their order."""
        n = self._model.size
        back, information = np.zeros(n), np.zeros((n, n))
        found = []
        for t, state, M, m, N in reversed(self._nodes):
            back = M @ back + m
            information = M @ information @ M.T + N
            P = state.P[0]
            correction = -P @ back
            smoothed = state.copy()
            inject(smoothed.q_nb, smoothed.v_n, smoothed.lla, smoothed.imu, correction)
            common = len(state.imu)
            smoothed.x[0, common:] += correction[common:]
            sensor_errors(smoothed.errors, smoothed.imu, self._model.driven)
            smoothed.P[0] = _spread(P, information)
            found.append(Smoothed(t, smoothed))
        return found[::-1]


def _spread(P: Array, information: Array) -> Array:
    """P - P Lambda P (n, n), kept positive: in directions in which it is not, `LEAST` of P is left.

    In P^1/2 (1 - P^1/2' Lambda P^1/2) P^1/2' what is in brackets has eigenvalues from 0 to 1. Below zero it is by what
    the maps of time, taken in pieces of their own, are off those of the filter.
    """
    spread = P - P @ information @ P
    spread = 0.5 * (spread + spread.T)
    driven = np.flatnonzero(P.diagonal() > 0)
    sigma = np.sqrt(P.diagonal()[driven])
    block = np.ix_(driven, driven)
    scaled = spread[block] / np.outer(sigma, sigma)
    if not len(driven) or np.linalg.eigvalsh(scaled)[0] > 0:
        return spread
    own, axes = np.linalg.eigh(P[block] / np.outer(sigma, sigma))
    half = sigma[:, None] * axes * np.sqrt(np.maximum(own, 0.0))
    known, turn = np.linalg.eigh(half.T @ information[block] @ half)
    left = half @ (turn * np.sqrt(np.where(known < 1.0, 1.0 - known, LEAST)))
    spread[block] = left @ left.T
    return spread


def _joined(blocks: Sequence[ImuSamples]) -> ImuSamples:
    if not blocks:
        return ImuSamples(np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    return ImuSamples(*(np.concatenate([getattr(b, name) for b in blocks]) for name in ("t", "dt", "dtheta", "dv")))


def _sound(imu: ImuSamples, rates: Array) -> ImuSamples:
    """The same increments, those that are no numbers or impossible replaced by the last sound ``rates`` (2, 3)."""
    dtheta, dv = imu.dtheta.copy(), imu.dv.copy()
    for k in np.flatnonzero(~usable(dtheta, dv, imu.dt)):
        before = (dtheta[k - 1] / imu.dt[k - 1], dv[k - 1] / imu.dt[k - 1]) if k else rates
        dtheta[k], dv[k] = before[0] * imu.dt[k], before[1] * imu.dt[k]
    return ImuSamples(imu.t.copy(), imu.dt.copy(), dtheta, dv)


@njit
def _transition(
    Phi: Array, q_nb: Array, v_n: Array, lla: Array, errors: Array, estimated: Array, driven: Indices,
    dtheta: Array, dv: Array, dt: Array,
) -> float:  # fmt: skip
    """Fill ``Phi`` (9, common) as `error_model.transition` does, over N increments from a nominal state; their time."""
    sums, FT, T = np.zeros((3, 3, 3)), np.zeros_like(Phi), 0.0
    angle, push, rates = np.empty(3), np.empty(3), np.empty((2, 3))
    for k in range(len(dt)):
        before = q_nb.copy()
        for i in range(3):
            rates[0, i], rates[1, i] = dtheta[k, i] / dt[k], dv[k, i] / dt[k]
        take_errors(angle, push, rates, dt[k], errors, estimated, driven)
        step(q_nb, v_n, lla, angle, push, dt[k])
        integrate(sums, before, q_nb, angle, push, dt[k])
        T += dt[k]
    transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
    return T


@njit
def _advance(
    q_nb: Array, v_n: Array, lla: Array, errors: Array, estimated: Array, driven: Indices, rates: Array, dt: float
) -> None:
    """``dt`` seconds of the strapdown at the measured ``rates`` (2, 3), with known sensor errors, in place."""
    angle, push = np.empty(3), np.empty(3)
    take_errors(angle, push, rates, dt, errors, estimated, driven)
    step(q_nb, v_n, lla, angle, push, dt)
