"""The master of a federation: fuses what the local filters found, gives it back to them, and says what it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.columns import Estimates
from nav.detection import chi_square_threshold, whiten
from nav.error_model import POS
from nav.federation import Config
from nav.fusion import Master, blend, combine, information, reset, weights_by_covariance
from nav.local_filter import LocalFilter
from nav.reference import REPORTED, Reference, described, forget, spread, turned
from nav.samples import Array, Status
from nav.state import State, inject, known, parts

LOST_M = 1e4  # 1-sigma of a position that tells nothing any more, neither does its error model: it is not compared
MUCH_LESS = 9.0  # times the variance of a position, and less is known of it
CONTRADICTED = 1e-3  # a probability
LEAST_SHARE = 0.02  # of a filter with an isolated part, or when shares follow the covariances: it must come back


def noise_shares(config: Config, shares: Array, copies: int) -> Array:
    """By which noise and covariance are divided, for each row: ones when information is not shared."""
    return np.tile(np.ones(len(config.locals)) if config.sharing == "none" else shares, copies)


class MasterFilter:
    """Fuses the ``filters`` over a ``reference`` that has ``copies`` rows for each, its shadows among them."""

    def __init__(self, config: Config, filters: Sequence[LocalFilter], reference: Reference, copies: int) -> None:
        self.shares = config.shares
        self._config, self._filters, self._reference, self._copies = config, filters, reference, copies
        self._everyone = np.ones(len(filters))
        self.kept: set[str] = set()  # isolated sensors of which no filter holds anything false
        self._extra = self._extras()
        common = filters[0].model.slices.items()
        self._common = [(name, at) for name, at in common if at.start < reference.common and name not in REPORTED]

    def _extras(self) -> list[tuple[str, int, slice]]:
        """(name, row, where) of the further states in an estimate: a name that two filters have gets the filter's."""
        own = [
            (name, row, where)
            for row, filter_ in enumerate(self._filters)
            for name, where in filter_.model.slices.items()
            if where.start >= self._reference.common
        ]
        names = [name for name, _, _ in own]
        return [
            (f"{self._config.locals[row].name}_{name}" if names.count(name) > 1 else name, row, where)
            for name, row, where in own
        ]

    def noise_shares(self) -> Array:
        """See the function."""
        return noise_shares(self._config, self.shares, self._copies)

    def reset_shares(self) -> Array:
        """The shares of a fused covariance, for each filter: ones when the combination does not add information up."""
        return self.shares if self._config.combination == "information" else self._everyone

    def healthy(self) -> Array:
        """1 for each local filter without an isolated part, but of sensors that are `kept`, 0 for the others."""
        isolated = [
            any(w.suspect and sensor not in self.kept for (sensor, _), w in f.monitors.items()) for f in self._filters
        ]
        return 1.0 - np.array(isolated, dtype=float)

    def lost(self, state: State) -> npt.NDArray[np.bool_]:
        """Which filters know nothing of their position any more (filters,)."""
        variances = state.P[: len(self._filters), range(POS, POS + 3), range(POS, POS + 3)]  # not those of shadows
        lost: npt.NDArray[np.bool_] = variances.max(axis=1) >= LOST_M**2
        return lost

    def sound(self, state: State) -> Array:
        """1 for each filter that is healthy and not lost, 0 for the others."""
        return np.where(self.lost(state), 0.0, self.healthy())

    def rests_on(self, state: State, row: int) -> bool:
        """Whether the position is known by one filter, which has an isolated part, and no sound one contradicts it."""
        sound, place = self.sound(state), slice(POS, POS + 3)
        sound[row] = 0.0
        if not sound.any():
            return True
        others, everyone = self.combine(state, sound), self.combine(state, self._everyone)
        P = others.P[place, place]
        if np.trace(P) < MUCH_LESS * np.trace(everyone.P[place, place]):
            return False
        off = state.x[row, place] - others.x[place]
        return whiten(off, P + self.charted(state, row)[place, place])[1] <= chi_square_threshold(CONTRADICTED, 3)

    def start_again(self, state: State, faulty: LocalFilter, sensor: str) -> None:
        """Every filter from the fused solution of the sound ones, so that nothing stays of what the sensor told.

        Where there is none they stay as they are.
        """
        healthy = self.sound(state)
        if not healthy.any():
            return
        master = self.combine(state, healthy)
        row, model = faulty.row, faulty.model
        shares = self.reset_shares()
        if self._config.combination == "information":
            shares = np.where(healthy > 0, shares, 0.0)
            shares = np.where(
                healthy > 0, shares / shares.sum() * (1 - LEAST_SHARE * np.sum(healthy == 0)), LEAST_SHARE
            )
        for name in faulty.aids[sensor].states:
            if name in model.slices and model.decay_rate[model.slices[name].start] > 0:
                where = model.slices[name]
                state.x[row, where] = 0.0
                forget(state.P[row], where.start, model.sigma[where] ** 2)
        for i, share in enumerate(shares):
            self.reset(state, i, master.x, master.P / share)

    def combine(self, state: State, members: Array) -> Master:
        """The fused solution of the ``members`` (filters,), one or zero each."""
        n, config = len(self._filters), self._config
        P = state.P[:n]
        if self._reference.scalings:
            P = np.stack([self.charted(state, row) for row in range(n)])
        return combine(state.x[:n], P, self._reference.common, members, config.combination, config.weigh)

    def charted(self, state: State, row: int) -> Array:
        """A copy of one filter's P, as the covariance of its x; by sigma points it is that of its own estimate."""
        P = state.P[row]
        return turned(state.x[row], P, own=False) if row in self._reference.scalings else P.copy()

    def reset(self, state: State, row: int, x_g: Array, P_g: Array) -> None:
        """`nav.fusion.reset` one filter."""
        if row not in self._reference.scalings:
            reset(state.x[row], state.P[row], x_g, P_g)
            return
        P = self.charted(state, row)
        reset(state.x[row], P, x_g, P_g)
        state.P[row] = turned(state.x[row], P, own=True)

    def fuse(self, state: State) -> None:
        """Fuse, correct the nominal state, reset the filters as the structure says."""
        config, n = self._config, len(self._filters)
        if config.sharing == "by_covariance":
            by = weights_by_covariance(state.P[:n], self._reference.common, self._everyone, self.shares)
            by = np.maximum(by, LEAST_SHARE)
            self.shares = by / by.sum()
            self._reference.share_noise(self.noise_shares())
        master = self.combine(state, self._everyone)
        retention = {"no_reset": 0.0, "full_reset": 1.0, "partial": config.retention}[config.structure]
        if retention > 0:
            for i, share in enumerate(self.reset_shares()):
                target = master.x, master.P / share
                if retention < 1:
                    target = blend(state.x[i], self.charted(state, i), *target, retention)
                self.reset(state, i, *target)
        self._reference.correct(state, master.x)

    def told(
        self, wholes: Array, shape: tuple[int, int, int], t: Array, status: Sequence[Status], off: Array
    ) -> Estimates:
        """The estimates of settled states (N, numbers), which are changed; the motion may be ``off`` (N, 9)."""
        common, model = shape[0], self._filters[0].model
        if self._config.combination == "information" and not self._reference.scalings:
            masters = _combined(wholes, *shape, self._everyone)
        else:
            masters = np.empty((len(wholes), common, common))
            for k, whole in enumerate(wholes):
                state = State(*shape, whole)
                master = self.combine(state, self._everyone)
                inject(state.q_nb, state.v_n, state.lla, state.imu, master.x)
                masters[k] = turned(master.x, master.P, own=True) if self._reference.scalings else master.P
        q_nb, v_n, lla, imu, x, _ = known(wholes, *shape)
        rows, deviation = masters.reshape(len(t), -1), deviations(wholes, *shape)
        covariance, sigma = spread(rows, 0, common, self._config.mounting_sigma**2, off)
        extra = {name: (imu[:, at], sigma[:, at]) for name, at in self._common}
        extra |= {name: (x[:, row, where], deviation[:, row, where]) for name, row, where in self._extra}
        return described(t, status, (q_nb, v_n, lla), imu, (rows, 0), model, covariance, sigma, extra)


@njit
def _combined(wholes: Array, common: int, filters: int, n: int, members: Array) -> Array:
    """The fused covariances (N, common, common) of settled states, whose nominal states get what was fused.

    By information, of the first filters, as many as there are ``members``: in one go, since to hand the parts of one
    state over from a kernel takes longer than to fuse them.
    """
    masters, m = np.empty((len(wholes), common, common)), len(members)
    for k in range(len(wholes)):
        q_nb, v_n, lla, imu, x, P, _, _, _, _, _, _ = parts(wholes[k], common, filters, n)
        x_g, P_g = information(x[:m], P[:m], common, members)
        for i in range(common):
            for j in range(common):
                masters[k, i, j] = P_g[i, j]
        inject(q_nb, v_n, lla, imu, x_g)
    return masters


@njit
def deviations(wholes: Array, common: int, filters: int, n: int) -> Array:
    """1-sigma (N, filters, n) of the states of all filters, of N states of which each is the whole of a `State`."""
    sigma = np.empty((len(wholes), filters, n))
    for k in range(len(wholes)):
        P = parts(wholes[k], common, filters, n)[5]
        for f in range(filters):
            for i in range(n):
                sigma[k, f, i] = np.sqrt(P[f, i, i])
    return sigma
