"""A local filter: aids with the states of their errors, a detector and a measurement policy for each measurement.

An aid is one sensor as the filter models it (`nav.aids`). A sample gives one or more measurements (`Aid.parts`:
position and velocity of a GNSS sample), and each goes the same way: innovation at the filter's own estimate, detector,
policy, update. `nav.ins` closes a strapdown with one such filter, `nav.federated` with several.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from nav import unscented
from nav._jit import lean, njit
from nav.aids.airspeed import AirspeedAid, Silence
from nav.aids.barometer import BarometerAid, Scatter
from nav.aids.base import (
    FUSED,
    OUTSIDE,
    Aid,
    AidAtPoints,
    Measurement,
    OperatingPoint,
    Ruling,
    aid_blocks,
    report_on,
)
from nav.aids.gnss import Contradiction, GnssAid, Wake
from nav.claims import Claim, FollowingAid
from nav.detection import ChiSquareGate, Mask, WindMemory, whiten
from nav.error_model import MOTION, POS, VEL, ErrorModel, ImuModel, sensor_errors
from nav.kalman import innovate, scratch
from nav.monitor import Monitor, MonitoredAid, Patience
from nav.reference import Reference, forget, remove_open
from nav.samples import AirspeedSample, Array, BarometerSample, GnssSample, Outcome, Sample, UpdateReport
from nav.smoother import Smoother
from nav.state import State, absorb
from nav.unscented import CURVED, Scaling
from nav.weighting import Fading, Policy, SageHusa, split

AIRED_S = 5.0  # after an airspeed, as long as the slowest of receivers and tubes leave between two samples
LEFT_OUT = Ruling(Outcome.WEAKENED, "left out by the measurement policy")


class LocalFilter:
    """One filter's aids and what becomes of their samples; the numbers are rows ``row`` of a `State`.

    ``closed`` filters put each correction into the nominal state at once. With a ``scaling`` they work by sigma points
    around the filter's own estimate. Parts without a `Monitor` pass the ``gate``. Claims follow innovations
    (`nav.claims`) in closed filters only: monitors judge by what is told.
    """

    def __init__(
        self,
        imu: ImuModel,
        aids: Sequence[Aid],
        gate: ChiSquareGate,
        row: int = 0,
        closed: bool = True,
        scaling: Scaling | None = None,
    ) -> None:
        self.aids = {aid.sensor: aid for aid in aids}
        if len(self.aids) < len(aids):
            raise ValueError(f"a sensor is listed twice: {[aid.sensor for aid in aids]}")
        self.model = ErrorModel(imu, aid_blocks(aids))
        self.gate, self.row, self.closed, self.scaling = gate, row, closed, scaling
        self.monitors: dict[tuple[str, str], Monitor] = {}
        self.of_sensor: dict[str, list[Monitor]] = {}
        self.noises: dict[str, SageHusa] = {}  # of parts without a monitor, as the two below
        self.policies: dict[str, Policy] = {}
        self.fadings: Mapping[str, Fading] = {}
        self.claims = {
            (aid.sensor, part): Claim(following)
            for aid in aids
            if closed and isinstance(aid, FollowingAid)
            for part, following in aid.following.items()
        }
        self.smoother: Smoother | None = None  # told of each update of a closed filter, if there is one
        self._at_points = {aid.sensor: aid for aid in aids if isinstance(aid, AidAtPoints)}
        self.starts = {aid.sensor: tuple(map(self.model.start, aid.states)) for aid in aids}
        air = self._air()
        self._aired = -math.inf  # when an airspeed was used last
        self._scatters = {aid.sensor: Scatter() for aid in aids if isinstance(aid, BarometerAid) and aid.scatters}
        self._contradictions = {
            aid.sensor: Contradiction(aid.largest_jump) for aid in aids if isinstance(aid, GnssAid) and aid.largest_jump
        }
        self._wakes = {aid.sensor: Wake() for aid in aids if isinstance(aid, GnssAid) and aid.latency_sigma}
        self.silence = Silence(air.sensor) if air is not None and air.sideslip_sigma is not None else None

    def monitor(self, monitored: MonitoredAid, patience: Patience) -> None:
        """Monitor each part of a sensor's samples, from a clean record."""
        sensor, policy = monitored.aid.sensor, monitored.policy
        for part, size in monitored.aid.parts:
            self.monitors[sensor, part] = Monitor(
                monitored.detector(), policy() if policy else None, size, patience, monitored.coloured
            )
        self.of_sensor[sensor] = [self.monitors[sensor, part] for part, _ in monitored.aid.parts]

    def weigh_by(self, policies: Mapping[str, Policy]) -> None:
        """Weigh the parts of samples that have no monitor, by their names; what learns R replaces a claim on it."""
        for part, policy in policies.items():
            noise, rest = split(policy)
            if noise is not None:
                self.noises[part] = noise
                self.claims = {key: claim for key, claim in self.claims.items() if key[1] != part}
            if rest is not None:
                self.policies[part] = rest

    def wind_memory(self) -> WindMemory | None:
        """An empty memory of the wind that this filter estimates, None when it estimates none."""
        aid = self._air()
        return None if aid is None else WindMemory(aid.wind_walk, aid.gust_sigma)

    def _air(self) -> AirspeedAid | None:
        return next((aid for aid in self.aids.values() if isinstance(aid, AirspeedAid)), None)

    def stand_in(self, sample: Sample) -> Sample | None:
        """What stands in for a pitot tube that has fallen silent, once a sound ``sample`` of any sensor was used."""
        return None if self.silence is None else self.silence.stand_in(sample)

    def remember_wind(self, memory: WindMemory | None, state: State, t: float) -> None:
        """Put the mean wind into the ``memory``, if there is one."""
        if memory is not None:
            wind = self.model.slices["wind"]
            memory.remember(t, state.x[self.row, wind], state.P[self.row].diagonal()[wind])

    def odds(self, memory: WindMemory | None, state: State, v_n: Array, t: float) -> float:
        """What the ``memory`` of the wind says for a velocity (3,) against this filter's own: `WindMemory.odds`.

        It says nothing for a filter that used no airspeed for `AIRED_S`: its wind keeps still whatever its velocity is.
        """
        if memory is None:
            return 0.0
        own = state.x[self.row]
        v_own = state.v_n if self.closed else state.v_n + own[VEL : VEL + 3]
        air = own[self.model.slices["wind"]].copy()
        if "gust" in self.model.slices:
            air += own[self.model.slices["gust"]]
        odds = memory.odds(t, air, (v_n - v_own)[:2])
        return odds if t - self._aired <= AIRED_S else max(odds, 0.0)

    def forget_air(self, state: State) -> None:
        """Give wind and gusts, if there are any, the variances that they began with."""
        for name in ("wind", "gust"):
            where = self.model.slices.get(name)
            if where is not None:
                forget(state.P[self.row], where.start, self.model.sigma[where] ** 2)
        if "gust" in self.model.slices:
            state.x[self.row, self.model.slices["gust"]] = 0.0

    def reopen_wind(self, state: State, change: Array, lasting_s: float) -> None:
        """Let the wind have changed by ``change`` (2,) [m/s], at any time in the last ``lasting_s`` [s].

        The velocity through the air is as well known as before: that over ground went along with the wind, and took the
        position along since then. Of a filter without wind it is that over ground which may have changed.
        """
        P, wind = state.P[self.row], self.model.slices.get("wind")
        for axis in range(2):
            along = np.zeros(len(P))
            along[VEL + axis] = change[axis]
            if wind is not None:
                along[wind.start + axis] = change[axis]
            along[POS + axis] = 0.5 * lasting_s * change[axis]
            P += np.outer(along, along)
            P[POS + axis, POS + axis] += (lasting_s * change[axis]) ** 2 / 12.0

    def limits(self, sensor: str) -> tuple[float, ...] | None:
        """The largest statistic of each part of a sensor's samples, up to which it is simply used.

        None where more has to be decided, or is asked of what a sample is.
        """
        if sensor in self._scatters or sensor in self._contradictions:
            return None
        limits = []
        for part, m in self.aids[sensor].parts:
            if (sensor, part) in self.claims:
                return None
            monitor = self.monitors.get((sensor, part))
            if monitor is None:
                special = part in self.policies or part in self.fadings or part in self.noises
                limit = None if special else self.gate.threshold(m)
            else:
                limit = monitor.limit(m)
            if limit is None:
                return None
            limits.append(limit)
        return tuple(limits)

    def _noise(self, sensor: str, part: str) -> SageHusa | None:
        """What learns the variances of one part of a sensor's samples."""
        monitor = self.monitors.get((sensor, part))
        return self.noises.get(part) if monitor is None else monitor.noise

    def heard(self, reference: Reference, state: State, part: str, sample: Sample, nis: float, m: int) -> None:
        """One part of a sample, of ``m`` axes, was held against the estimate: what is claimed of it may follow."""
        claim = self.claims.get((sample.sensor, part))
        if claim is None:
            return
        before = claim.scale
        claim.heard(nis / m, sample.t)
        self._rescale(reference, state, claim, before)

    def claim_as_told(self, reference: Reference, state: State) -> None:
        """The filter begins anew, and so do its claims."""
        for claim in self.claims.values():
            before = claim.scale
            claim.begin()
            self._rescale(reference, state, claim, before)

    def _rescale(self, reference: Reference, state: State, claim: Claim, before: float) -> None:
        """Let an error be driven as is claimed now; it is stationary: what it may be grows at once, to what is told."""
        if not claim.following.state:
            return
        reference.scale_noise(self.row, self.model.slices[claim.following.state], claim.scale)
        k, P = self.model.start(claim.following.state), state.P[self.row]
        if claim.scale > before:
            P[k, k] = max(P[k, k], min(P[k, k] * claim.scale / before, claim.following.sigma**2))

    def learned_sigma(self, part: str, sigma: Array) -> Array:
        """A sensor's 1-sigma (m,) of one part of its samples: the ``sigma`` it reports, or what was learned."""
        noise = self.noises.get(part)
        return sigma if noise is None or noise.ratio is None else sigma * np.sqrt(noise.ratio)

    def measure(self, reference: Reference, state: State, aid: Aid, part: str, sample: Sample) -> Measurement | None:
        """One part of a sample with the filter's own errors of aids, its R as learned.

        It is at the nominal state; by sigma points, at the filter's own estimate.
        """
        if self.scaling is None:
            return self.measure_at_nominal(reference, state, aid, part, sample)
        state = state if self.closed else reference.own(state, self.row)
        measurement = self.measure_at_nominal(reference, state, aid, part, sample)
        if measurement is None:
            return None
        starts = self.starts[aid.sensor]
        root = unscented.factor(state.P[self.row], CURVED)
        points = unscented.points(state.q_nb, state.v_n, state.lla, self._whole(state), root, self.scaling.spread)
        if aid.sensor in self._at_points:
            here = OperatingPoint(reference, state, state.x[self.row], starts, state.P[self.row])
            found = self._at_points[aid.sensor].at_points(part, sample, here, points)
            if found is not None:
                return measurement._replace(at_points=found)
        at_points, there = np.empty((len(points.x), len(measurement.nu))), state.copy()
        for k, (q_nb, v_n, lla, x) in enumerate(zip(*points, strict=True)):
            there.q_nb[:], there.v_n[:], there.lla[:] = q_nb, v_n, lla
            sensor_errors(there.errors, x, reference.driven)
            at_point = aid.measure(part, sample, OperatingPoint(reference, there, x, starts, state.P[self.row]))
            assert at_point is not None  # as whether there is a measurement depends on the sample alone
            at_points[k] = at_point.nu
        return measurement._replace(at_points=at_points)

    def measure_at_nominal(
        self, reference: Reference, state: State, aid: Aid, part: str, sample: Sample
    ) -> Measurement | None:
        """One part of a sample at the nominal state and the filter's own errors of aids, its R as learned."""
        here = OperatingPoint(reference, state, state.x[self.row], self.starts[aid.sensor], state.P[self.row])
        measurement = aid.measure(part, sample, here)
        noise = self._noise(aid.sensor, part)
        if measurement is not None and isinstance(sample, BarometerSample) and aid.sensor in self._scatters:
            scatter = self._scatters[aid.sensor].heard(sample)
            measurement = measurement._replace(R=np.maximum(measurement.R, scatter))
        if measurement is not None and part == "gnss_velocity" and aid.sensor in self._wakes:
            assert isinstance(aid, GnssAid)
            now = aid.manoeuvre(state)
            measurement = measurement._replace(R=measurement.R + self._wakes[aid.sensor].heard(sample.t, now) - now)
        claim = self.claims.get((aid.sensor, part))
        if measurement is not None and claim is not None and not claim.following.state:
            measurement = measurement._replace(R=claim.at(sample.t) * measurement.R)
        if measurement is None or noise is None:
            return measurement
        return measurement._replace(R=noise.learned(measurement.R), reported=measurement.R)

    def _whole(self, state: State) -> Array:
        """All estimated values beyond the motion (n,) of a closed filter, those of the inertial sensors too."""
        x: Array = state.x[self.row].copy()
        x[: len(state.imu)] = state.imu
        return x

    def gated(self, part: str, sample: Sample, nu: Array, S: Array, nis: float) -> tuple[float, float, float]:
        """The statistic that the gate judges, its threshold, and what that is of the ``nis``, which is reported."""
        judged, threshold = self.as_judged(part, sample, S), self.gate.threshold(len(nu))
        if judged is S:
            return nis, threshold, threshold
        statistic = whiten(nu, judged)[1]
        return statistic, threshold, threshold * nis / statistic if statistic > 0.0 else threshold

    def as_judged(self, part: str, sample: Sample, S: Array) -> Array:
        """S (m, m) as a detector or a gate is given it.

        That of positions is wider by what velocities contradict them, of velocities by what a manoeuvre does at once.
        """
        if part == "gnss_position" and sample.sensor in self._contradictions:
            assert isinstance(sample, GnssSample)
            more = self._contradictions[sample.sensor].heard(sample)
        elif part == "gnss_velocity" and sample.sensor in self._wakes:
            more = self._wakes[sample.sensor].onset
        else:
            return S
        wide: Array = S + np.diag(more)
        return wide

    def innovate(self, state: State, measurement: Measurement) -> tuple[Array, Array, float]:
        """(nu, S, nis) of a measurement at the filter's own estimate."""
        if measurement.at_points is not None:
            nu, S, _, nis = self._innovate_points(
                state.P[self.row], measurement.at_points, measurement.H, measurement.R
            )
            return nu, S, nis
        return own_innovation(
            state.P[self.row], state.x[self.row], len(state.imu), measurement.H, measurement.R, measurement.nu
        )

    def absorb(
        self,
        reference: Reference,
        state: State,
        nu: Array,
        H: Array,
        R: Array,
        threshold: float,
        at_points: Array | None = None,
    ) -> tuple[Array, float]:
        """Correct if nis is at most ``threshold``; (S, nis). ``nu`` is at the filter's own estimate."""
        s = state
        if self.scaling is not None:
            assert at_points is not None
            return self._absorb_points(reference, s, at_points, H, R, threshold)
        before = s.P[self.row].copy() if self.smoother is not None else None
        S, inverses, work = scratch(len(nu), s.shape[2])
        nis = absorb(
            s.whole, *s.shape, self.row, reference.driven, nu, H, R, threshold, self.closed, S, inverses, work
        )  # fmt: skip
        if self.smoother is not None and before is not None and nis <= threshold:
            self.smoother.updated(before, H, nu, S)
        return S, nis

    def _innovate_points(self, P: Array, at_points: Array, H: Array, R: Array) -> tuple[Array, Array, Array, float]:
        """`unscented.innovate`: minus ``at_points`` is prediction - measurement, so that zero is measured."""
        assert self.scaling is not None
        root, z, work = unscented.factor(P, CURVED), np.zeros(len(R)), unscented.scratch(len(P), len(R))
        spread, excess = self.scaling.spread, self.scaling.excess
        nu, S, W, nis = unscented.innovate(P, -at_points, z, R, root, H, work, spread, excess)
        return nu.copy(), S.copy(), W, nis

    def _absorb_points(
        self, reference: Reference, state: State, at_points: Array, H: Array, R: Array, threshold: float
    ) -> tuple[Array, float]:
        """`absorb` by sigma points."""
        s, P = state, state.P[self.row]
        _, S, W, nis = self._innovate_points(P, at_points, H, R)
        if nis <= threshold:
            error = unscented.correct(P, W, unscented.scratch(len(P)))
            if not self.closed:
                remove_open(s.x[self.row], error)
                return S, nis
            x, common = self._whole(s), len(s.imu)
            unscented.remove(s.q_nb, s.v_n, s.lla, x, error)
            s.imu[MOTION:], s.x[self.row, common:] = x[MOTION:common], x[common:]
            sensor_errors(s.errors, s.imu, reference.driven)
        return S, nis

    def fuse(
        self, reference: Reference, state: State, sample: Sample, part: str, measurement: Measurement,
        withheld: Ruling | None = None,
    ) -> UpdateReport:  # fmt: skip
        """Gate, policy and correction of a closed filter; without correction where ``withheld`` says why."""
        withheld = withheld or measurement.withheld
        threshold = self.gate.threshold(len(measurement.nu))
        nu, H, R, at_points = measurement.nu, measurement.H, measurement.R, measurement.at_points
        simple = part not in self.policies and part not in self.fadings and part not in self.noises
        limit = threshold if simple and not withheld else -math.inf
        S, nis = self.absorb(reference, state, nu, H, R, limit, at_points)
        ruling = withheld or (FUSED if nis <= threshold else OUTSIDE)
        if not simple and ruling is FUSED:
            ruling = self.weigh(reference, state, sample, part, measurement, S)
        if not withheld:
            self.heard(reference, state, part, sample, nis, len(nu))
        if ruling.weight > 0 and isinstance(sample, AirspeedSample):
            self._aired = sample.t  # nobody asks where steps are taken many at once: while no fix contradicts
        return report_on(sample, part, nu, S, nis, threshold, ruling)

    def off(self, reference: Reference, state: State, aid: Aid, part: str, sample: Sample) -> Array | None:
        """Squares (m,) of what a part that a sample has may be off by, where that is outside its gate."""
        measurement = self.measure(reference, state, aid, part, sample)
        assert measurement is not None
        nu, H, R, at_points = measurement.nu, measurement.H, measurement.R, measurement.at_points
        S, nis = self.absorb(reference, state, nu, H, R, -math.inf, at_points)
        squares: Array = nu**2 + np.diag(S)
        return None if nis <= self.gate.threshold(len(nu)) else squares

    def weigh(
        self, reference: Reference, state: State, sample: Sample, part: str, measurement: Measurement, S: Array
    ) -> Ruling:
        """Correct a closed filter with a measurement that passed its gate, as fading and policy say: see `take`."""
        fading = self.fadings.get(part)
        factor = fading.factor(measurement.nu, S) if fading is not None else 1.0
        if factor > 1.0:
            state.P[self.row] *= factor
            again = self.measure(reference, state, self.aids[sample.sensor], part, sample)
            assert again is not None
            measurement = again
            S, _ = self.absorb(
                reference, state, measurement.nu, measurement.H, measurement.R, -math.inf, measurement.at_points
            )
        every = np.full(len(measurement.nu), True)
        noise, policy = self._noise(sample.sensor, part), self.policies.get(part)
        return self.take(reference, state, measurement, measurement.nu, S, every, noise, policy, sample.t)

    def take(
        self,
        reference: Reference,
        state: State,
        measurement: Measurement,
        nu: Array,
        S: Array,
        used: Mask,
        noise: SageHusa | None,
        policy: Policy | None,
        t: float,
    ) -> Ruling:
        """Correct with the ``used`` axes as far as the policy lets them; what was used teaches ``noise``.

        The weight is the mean factor on the information, one of an axis without noise.
        """
        H, R, at_points = measurement.H, measurement.R, measurement.at_points
        whole = bool(used.all())
        if policy is None and noise is None and whole:
            self.absorb(reference, state, nu, H, R, math.inf, at_points)
            return FUSED
        if not whole:
            R = np.where(used, R, np.inf)
        if policy is not None and used.any():
            if whole:
                R = policy.adapt(nu, S, R, t)
            else:
                R[used] = policy.adapt(nu[used], S[np.ix_(used, used)], measurement.R[used], t)
            used = np.isfinite(R)
            if not used.any():
                return LEFT_OUT
        if noise is not None:
            noise.learn(nu, S - np.diag(measurement.R), R)
        if used.all():
            self.absorb(reference, state, nu, H, R, math.inf, at_points)
        elif used.any():
            at_points = None if at_points is None else at_points[:, used]
            self.absorb(reference, state, nu[used], H[used], R[used], math.inf, at_points)
        reported = measurement.R if measurement.reported is None else measurement.reported
        weight = float(np.divide(reported, R, out=np.ones(len(R)), where=R > 0.0).sum()) / len(R)
        return Ruling(Outcome.FUSED if weight >= 1.0 else Outcome.WEAKENED, weight=weight)


@njit
def own_innovation(P: Array, x: Array, common: int, H: Array, R: Array, nu: Array) -> tuple[Array, Array, float]:
    """(innovation, S, nis) at nominal state plus ``x[:common]``, from the innovation ``nu`` (m,) at the nominal one."""
    own = nu.copy()
    from_nominal(own, H, x, common)
    S, _, _, nis = innovate(P, H, R, own)
    return own, S, nis


@lean
def from_nominal(nu: Array, H: Array, x: Array, common: int) -> None:
    """Make of the innovation ``nu`` (m,) at the nominal state the one at that plus ``x[:common]``, in place."""
    for k in range(len(nu)):
        for j in range(common):
            nu[k] -= H[k, j] * x[j]
