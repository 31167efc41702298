"""Flights of the papers: what they have in common is flown once, and changes no bit."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.papers import flights, scenario
from testbed.papers.flights import Flight, Sensed, Track

T = np.arange(0.0, 20.5, 0.5)
CHOSEN = scenario("zhou2025", ("duration_s=20", "expect={}", "fault=[]"))


@pytest.fixture(scope="module")
def sensed() -> Sensed:
    """The first seconds of the circuit."""
    return Sensed.of(CHOSEN, 3)


def same(one: Track, other: Track) -> None:
    np.testing.assert_array_equal(one.every, other.every)
    np.testing.assert_array_equal(one.sigma, other.sigma)
    assert [report.nis for report in one.reports] == [report.nis for report in other.reports]


@pytest.mark.parametrize("name", ["fkf", "improved"])
def test_a_fork_is_the_flight_from_its_beginning(sensed: Sensed, name: str) -> None:
    whole = flights.track(flights.lanes(CHOSEN, 3)[name], sensed, T)
    trunk = Flight(flights.lanes(CHOSEN, 3)[name], sensed)
    trunk.on(T[T < 8])
    fork = trunk.fork(sensed)
    for flight in (fork, trunk):
        flight.on(T[T >= 8])
        same(flight.track(), whole)


def test_a_fork_goes_its_own_way(sensed: Sensed) -> None:
    trunk = Flight(flights.lanes(CHOSEN, 3)["fkf"], sensed)
    trunk.on(T[T < 8])
    denied = trunk.fork(Sensed(sensed.truth, {**sensed.samples, "gnss": []}))
    denied.on(T[T >= 8])
    trunk.on(T[T >= 8])
    last = [flight.track().looks("gnss_position").t[-1] for flight in (denied, trunk)]
    assert last == pytest.approx([7, 20])
    same(trunk.track(), flights.track(flights.lanes(CHOSEN, 3)["fkf"], sensed, T))
