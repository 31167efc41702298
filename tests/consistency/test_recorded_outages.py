"""Recorded flights with GNSS removed at eight starts: error against the GNSS that was kept back, and what is claimed.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_outages.py`` prints the table, NIS of each
aid with GNSS, and what an outage would be if the filter were told one of its states, as a smoother of the whole flight
has it: so it is seen which one drifts.
"""

from __future__ import annotations

import bisect
import copy
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from worlds import real_flights

from nav import kalman
from nav.earth import displacement_n
from nav.error_model import PHI
from nav.ins import Ins
from nav.rotation import dcm_from_quat
from nav.samples import Array, GnssSample, ImuSamples, Outcome, UpdateReport
from nav.state import State, absorb
from testbed import Scenario
from testbed.estimators import registry
from testbed.feeds.recorded import Recorded, located

BLOCK_S = 0.5
STARTS = 8
# When it flies [s of the run], and how long after GNSS was removed it is looked at.
FLOWN = {"thor": (155.0, 518.0, (30, 60, 120, 180)), "swiss": (25.0, 149.0, (10, 30, 60)), "quad": (60, 690, (10, 30))}
# Horizontal error at those, median over the starts; about a third above what was measured.
MOST = {"thor": (40, 60, 150, 300), "swiss": (20, 85, 110), "quad": (8, 60)}
# By the wind alone, at the last of these, whatever is forecast of it: a little less than was measured.
LEAST = {"thor": 85, "swiss": 0}
# What a filter is told each half second, how well: the tilt and heading, the mean wind, the biases [rad, m/s, SI].
TOLD = {"phi": 3e-3, "wind": 0.1, "gyro_bias": 1e-4, "accel_bias": 3e-3}
TELLING = ((), ("phi",), ("gyro_bias", "accel_bias"), ("wind",))
AT_FIRST = (("phi",), ("wind",))  # the same, when GNSS is removed and not after

Tell = Callable[[Ins], None]


class Flight:
    """A recorded flight, its INS, and how far it has come."""

    def __init__(self, name: str, folder: Path, smooth: bool = False) -> None:
        path = folder / "flight.toml"
        path.write_text(real_flights.FLIGHTS[name], "utf-8")
        scenario = located(Scenario.load(path, {"truth.reference": "gnss", "estimator.ins.smooth": smooth}))
        self.feed = Recorded(scenario, 1)
        section = next(one for one in scenario.estimator if one.name == "ins")
        self.lane = registry.build([section], scenario.rig(1))["ins"]
        self.samples = sorted(
            (one for name in self.lane.sensors for one in self.feed._samples[name]), key=lambda one: one.t_arrival
        )
        self.arrivals = [one.t_arrival for one in self.samples]
        self.t = self.known = 0.0  # and up to where there are increments
        self.reports: list[UpdateReport] = []

    @property
    def ins(self) -> Ins:
        """Its filter."""
        found = self.lane.horizon.estimator
        assert isinstance(found, Ins)
        return found

    def branch(self) -> Flight:
        """The same from here on, with an estimator of its own."""
        other = copy.copy(self)
        other.lane = copy.deepcopy(self.lane)
        other.reports = []
        return other

    def fly(
        self, until: float, denied: bool, times: list[float], tell: Tell | None = None
    ) -> list[tuple[float, float, float]]:
        """Go on; horizontal error [m], NEES per axis, claimed sigma [m] at ``times``, each of a fix kept back.

        The filter is handed to ``tell`` after each block.
        """
        found = []
        imu = next(iter(self.feed._imus.values()))
        while self.t < until - 1e-9:
            end = min(self.t + BLOCK_S, until)
            first, stop = np.searchsorted(imu.t, [self.t + 1e-6, end + 1e-6])
            rows = slice(int(first), int(stop))
            block = ImuSamples(imu.t[rows], imu.dt[rows], imu.dtheta[rows], imu.dv[rows])
            arrived = slice(*(bisect.bisect_right(self.arrivals, edge + 1e-6) for edge in (self.t, end)))
            samples = [
                one
                for one in self.samples[arrived]
                if not (denied and isinstance(one, GnssSample)) and self.lane._thinned(one.sensor, [one])
            ]
            known = float(imu.t[stop - 1]) if stop else 0.0
            here = [t for t in times if self.known < t <= known]
            reports, estimates = self.lane.horizon.track(block, samples, here)
            self.reports += reports
            for estimate in estimates:
                fix = next(one for one in self.feed._samples["gnss"] if one.t == estimate.t)
                off = displacement_n(estimate.lat, estimate.lon, estimate.h, fix.lat, fix.lon, fix.h)
                claimed = estimate.covariance[:3, :3]
                nees = off @ np.linalg.solve(claimed + np.diag(fix.sigma_position_n**2), off) / 3
                found.append((float(np.hypot(*off[:2])), float(nees), float(np.sqrt(claimed[0, 0] + claimed[1, 1]))))
            self.t, self.known = end, known
            if tell is not None:
                tell(self.ins)
        return found


class Smoothed:
    """What a flight's filter says, knowing the whole flight: a reference for every state."""

    def __init__(self, name: str, folder: Path) -> None:
        flight = Flight(name, folder, smooth=True)
        flight.fly(FLOWN[name][1], False, [])
        assert flight.ins._smoother is not None
        times = np.arange(FLOWN[name][0], FLOWN[name][1] - 1, 0.1)
        self.states = {round(one.t, 1): one.state.copy() for one in flight.ins._smoother.states(times.tolist())}

    def telling(self, names: Sequence[str]) -> Tell:
        """Measure these states of a filter, each as `TOLD`, by what is known of them."""

        def tell(ins: Ins) -> None:
            state = ins._state
            assert state is not None
            ins._reference.settle(state)
            true = self.states[round(ins.t, 1)]
            for name in names:
                where = ins.model.slices[name]
                if where.start == PHI:
                    turn = dcm_from_quat(state.q_nb) @ dcm_from_quat(true.q_nb).T  # I - [phi x]
                    nu = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
                elif where.stop <= len(state.imu):
                    nu = true.imu[where] - state.imu[where]
                else:
                    nu = true.x[0, where] - state.x[0, where]
                H = np.eye(state.shape[2])[where]
                R = np.full(len(nu), TOLD[name] ** 2)
                room = kalman.scratch(len(nu), state.shape[2])
                absorb(state.whole, *state.shape, 0, ins.model.driven, nu, H, R, np.inf, True, *room)

        return tell


def forecast(smoothed: Smoothed, where: slice, starts: Sequence[float], marks: Sequence[int]) -> dict[str, Array]:
    """Median drift [m] at ``marks`` [s] by the change of the wind alone, all else being known, of several forecasts.

    What they forecast from is the wind that a smoother has of the whole flight: no filter knows as much.
    """
    t = np.array(sorted(smoothed.states))
    wind = np.array([smoothed.states[key].x[0, where] for key in t])
    drifts: dict[str, list[list[float]]] = {}
    for start in starts:
        before, after = t <= start + 0.05, (t > start + 0.05) & (t <= start + marks[-1])
        ahead = t[after] - start
        lately = before & (t > start - 60)
        slope = np.polyfit(t[lately], wind[lately], 1)[0] if np.count_nonzero(lately) > 100 else np.zeros(2)
        now = wind[before][-1]
        for name, expected in {
            "as it is now": now + 0 * ahead[:, None],
            "going on as in the last minute": now + slope * 100 * -np.expm1(-ahead / 100)[:, None],
            "its mean of the whole flight": wind.mean(axis=0) + 0 * ahead[:, None],
        }.items():
            off = wind[after] - expected
            found = [float(np.hypot(*(mark * off[ahead <= mark].mean(axis=0)))) for mark in marks]
            drifts.setdefault(name, []).append(found)
    return {name: np.median(rows, axis=0) for name, rows in drifts.items()}


def aided(reports: Sequence[UpdateReport], after: float) -> dict[str, tuple[float, float]]:
    """NIS per degree of freedom of each aid, and the share that was refused."""
    said = {}
    for aid in dict.fromkeys(one.aid for one in reports):
        own = [one for one in reports if one.aid == aid and one.t > after]
        nis = np.mean([one.nis / len(one.innovation) for one in own])
        said[aid] = float(nis), float(np.mean([one.outcome is not Outcome.FUSED for one in own]))
    return said


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", FLOWN)
def test_outages_of_recorded_flights(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(State, "__deepcopy__", lambda state, _: state.copy(), raising=False)  # its parts are views
    begins, ends, marks = FLOWN[name]
    flight = Flight(name, tmp_path)
    fixes = np.array([one.t for one in flight.feed._samples["gnss"]])
    rows = []
    for start in np.round(np.linspace(begins, ends - marks[-1] - 2, STARTS), 1):
        flight.fly(float(start), False, [])
        looks = [float(fixes[np.abs(fixes - start - mark).argmin()]) for mark in marks]
        rows.append(flight.branch().fly(looks[-1] + 0.5, True, looks))
    error, nees, claimed = np.moveaxis(np.array(rows), 2, 0)
    print(f"{name}: {marks} s: error {np.median(error, axis=0).round(1)} m (median), NEES per axis "
          f"{nees.mean(axis=0).round(2)} (mean), claims {np.median(claimed, axis=0).round(1)} m")  # fmt: skip
    flight.fly(ends - 2, False, [])
    with_gnss = aided(flight.reports, begins)
    said = ", ".join(f"{aid} {nis:.2f} ({refused:.1%})" for aid, (nis, refused) in with_gnss.items())
    print(f"{name}: NIS per degree of freedom with GNSS (refused): {said}")
    assert (np.median(error, axis=0) < MOST[name]).all()
    assert (nees.mean(axis=0) < 3.5).all()
    if name != "quad":  # whose claims are at their limits
        assert all(0.5 < nis < 2.0 and refused < 0.03 for nis, refused in with_gnss.values())


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", ["thor", "swiss"])
def test_an_aeroplane_drifts_with_the_wind(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a minute on the wind's own change is most of the drift.

    The smoother knows the wind by GNSS in the outage too: this is what no filter has, and shows where the rest is.
    """
    monkeypatch.setattr(State, "__deepcopy__", lambda state, _: state.copy(), raising=False)
    smoothed = Smoothed(name, tmp_path)
    begins, ends, marks = FLOWN[name]
    flight = Flight(name, tmp_path)
    fixes = np.array([one.t for one in flight.feed._samples["gnss"]])
    errors: dict[tuple[str, ...], list[list[float]]] = {names: [] for names in TELLING}
    once: dict[tuple[str, ...], list[list[float]]] = {names: [] for names in AT_FIRST}
    for start in np.round(np.linspace(begins, ends - marks[-1] - 2, STARTS), 1):
        flight.fly(float(start), False, [])
        looks = [float(fixes[np.abs(fixes - start - mark).argmin()]) for mark in marks]
        for names, rows in errors.items():
            found = flight.branch().fly(looks[-1] + 0.5, True, looks, smoothed.telling(names))
            rows.append([error for error, _, _ in found])
        for names, rows in once.items():
            branch = flight.branch()
            branch.fly(branch.t + BLOCK_S, True, [], smoothed.telling(names))
            rows.append([error for error, _, _ in branch.fly(looks[-1] + 0.5, True, looks)])
    for names, rows in once.items():
        median = np.median(rows, axis=0)
        print(f"{name}: {marks} s, told {names[0]} at the beginning alone: {median.round(1)} m (median)")
    medians = {names: np.median(rows, axis=0) for names, rows in errors.items()}
    for names, median in medians.items():
        print(f"{name}: {marks} s, told {' and '.join(names) or 'nothing'}: {median.round(1)} m (median)")
    assert medians["wind",][-1] < 0.75 * medians[()][-1]
    starts = np.linspace(begins, ends - marks[-1] - 2, STARTS).tolist()
    best = forecast(smoothed, flight.ins.model.slices["wind"], starts, marks)
    for forecasting, median in best.items():
        print(f"{name}: {marks} s, by the wind alone, taken {forecasting}: {median.round(1)} m (median)")
    assert min(median[-1] for median in best.values()) > LEAST[name]
