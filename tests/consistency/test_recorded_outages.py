"""Recorded flights with GNSS removed at eight starts: error against the GNSS that was kept back, and what is claimed.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_outages.py`` prints the table.
"""

from __future__ import annotations

import bisect
import copy
from pathlib import Path

import numpy as np
import pytest
from worlds import real_flights

from nav.earth import displacement_n
from nav.samples import GnssSample, ImuSamples
from nav.state import State
from testbed import Scenario
from testbed.estimators import registry
from testbed.feeds.recorded import Recorded, located

BLOCK_S = 0.5
STARTS = 8
# When it flies [s of the run], and how long after GNSS was removed it is looked at.
FLOWN = {"thor": (155.0, 518.0, (30, 60, 120, 180)), "swiss": (25.0, 149.0, (10, 30, 60)), "quad": (60, 690, (10, 30))}
# Horizontal error at those, median over the starts; about a third above what was measured.
MOST = {"thor": (40, 60, 150, 300), "swiss": (20, 85, 110), "quad": (8, 60)}


class Flight:
    """A recorded flight, its INS, and how far it has come."""

    def __init__(self, name: str, folder: Path) -> None:
        path = folder / "flight.toml"
        path.write_text(real_flights.FLIGHTS[name], "utf-8")
        scenario = located(Scenario.load(path, {"truth.reference": "gnss"}))
        self.feed = Recorded(scenario, 1)
        section = next(one for one in scenario.estimator if one.name == "ins")
        self.lane = registry.build([section], scenario.rig(1))["ins"]
        self.samples = sorted(
            (one for name in self.lane.sensors for one in self.feed._samples[name]), key=lambda one: one.t_arrival
        )
        self.arrivals = [one.t_arrival for one in self.samples]
        self.t = self.known = 0.0  # and up to where there are increments

    def branch(self) -> Flight:
        """The same from here on, with an estimator of its own."""
        other = copy.copy(self)
        other.lane = copy.deepcopy(self.lane)
        return other

    def fly(self, until: float, denied: bool, times: list[float]) -> list[tuple[float, float, float]]:
        """Go on; horizontal error [m], NEES per axis, claimed sigma [m] at ``times``, each of a fix kept back."""
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
                if not (denied and isinstance(one, GnssSample)) and self.lane._spaced(one.sensor, one)
            ]
            known = float(imu.t[stop - 1]) if stop else 0.0
            here = [t for t in times if self.known < t <= known]
            for estimate in self.lane.horizon.track(block, samples, here)[1]:
                fix = next(one for one in self.feed._samples["gnss"] if one.t == estimate.t)
                off = displacement_n(estimate.lat, estimate.lon, estimate.h, fix.lat, fix.lon, fix.h)
                claimed = estimate.covariance[:3, :3]
                nees = off @ np.linalg.solve(claimed + np.diag(fix.sigma_position_n**2), off) / 3
                found.append((float(np.hypot(*off[:2])), float(nees), float(np.sqrt(claimed[0, 0] + claimed[1, 1]))))
            self.t, self.known = end, known
        return found


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
    assert (np.median(error, axis=0) < MOST[name]).all()
    assert (nees.mean(axis=0) < 3.5).all()
