"""Estimates and reports one after the other are the single ones, in columns."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from nav.columns import Estimates, FusedReports, Reports
from nav.samples import Array, Estimate, Outcome, Status, UpdateReport


def single(t: float, **extra: tuple[Array, Array]) -> Estimate:
    rng = np.random.default_rng(int(10 * t))
    place = dict(zip(("lat", "lon", "h"), rng.normal(size=3).tolist(), strict=True))
    vectors = {name: rng.normal(size=3) for name in ("v_n", "gyro_bias", "accel_bias")}
    sigmas = {name: rng.random(3) for name in ("sigma_gyro_bias", "sigma_accel_bias")}
    q_nb, P = rng.normal(size=4), rng.normal(size=(9, 9))
    status = Status.ALIGNED | Status.BAD_SAMPLE
    return Estimate(t, **place, **vectors, **sigmas, q_nb=q_nb, covariance=P, status=status, extra=extra)


def assert_same(one: Estimate, other: Estimate) -> None:
    for each in fields(Estimate):
        if each.name != "extra":
            np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name))
    assert one.extra.keys() == other.extra.keys()
    for name, pair in one.extra.items():
        np.testing.assert_array_equal(pair, other.extra[name])


WIND = np.array([3.0, -1.0]), np.array([0.5, 0.6])
BIAS = np.array([12.0]), np.array([4.0])


def test_singles_and_several_at_once_keep_their_order() -> None:
    ones = [single(0.1), single(0.2, wind=WIND), single(0.3, wind=WIND, bias=BIAS), single(0.4), single(0.5, bias=BIAS)]
    cut = [Estimates.of(ones[:2]), ones[2], Estimates.of([]), ones[3], Estimates.of(ones[4:])]
    for found in (Estimates.of(ones), Estimates.of(cut), Estimates.of([Estimates.of(ones)])):
        assert len(found) == 5
        for one, expected in zip(found, ones, strict=True):
            assert_same(one, expected)
    assert Estimates.of(cut).extra["wind"][0].shape == (5, 2)
    assert np.isnan(Estimates.of(cut).extra["bias"][1][[0, 1, 3]]).all()


def test_some_of_them() -> None:
    found = Estimates.of([single(0.1 * k, wind=WIND) for k in range(6)])
    for part, t in ((found[:2], [0.0, 0.1]), (found[[1, 4]], [0.1, 0.4]), (found[:0], [])):
        np.testing.assert_allclose(part.t, t)
        assert len(part.covariance) == len(part.extra["wind"][1]) == len(part.status) == len(t)
    assert_same(found[-1], found[5])
    with pytest.raises(IndexError):
        found[6]


def test_arrays_of_any_kind_are_taken_by_their_values() -> None:
    """As a user's estimator may give them: whole numbers, every other number of more, rows stored as columns."""
    spread, turned = np.arange(8.0), np.asfortranarray(np.arange(81.0).reshape(9, 9))
    plain = Estimate.of(1.0, lla=np.zeros(3), v_n=np.arange(3.0), q_nb=spread[:4], covariance=np.ones((9, 9)))
    odd = replace(plain, v_n=np.array([4, 5, 6]), q_nb=spread[::2], covariance=turned)
    found = Estimates.of([plain, odd, plain])
    np.testing.assert_array_equal(found.v_n, [[0, 1, 2], [4, 5, 6], [0, 1, 2]])
    np.testing.assert_array_equal(found.q_nb, [[0, 1, 2, 3], [0, 2, 4, 6], [0, 1, 2, 3]])
    np.testing.assert_array_equal(found.covariance, [np.ones((9, 9)), turned, np.ones((9, 9))])
    assert {values.dtype for values in (found.v_n, found.q_nb, found.covariance)} == {np.dtype(float)}


def fused(t: Array) -> FusedReports:
    """Velocities of one receiver and, at every other time, pressures."""
    rng = np.random.default_rng(len(t))
    kinds = [("gps", "gnss_velocity", 3), ("baro", "barometer", 1)]
    numbers = rng.normal(size=(len(t), 3)), rng.normal(size=(len(t), 9)), rng.random(len(t)), rng.random(len(t))
    return FusedReports(kinds, np.arange(len(t)) % 2, t, *numbers)


def test_fused_reports_are_single_ones_in_columns() -> None:
    several = fused(np.arange(5.0))
    for k, one in enumerate(several):
        m = 1 if k % 2 else 3
        assert (one.t, one.sensor, one.aid) == (k, *several.kinds[k % 2][:2])
        np.testing.assert_array_equal(one.innovation, several.innovation[k, :m])
        np.testing.assert_array_equal(one.S.reshape(-1), several.S[k, : m * m])
        assert one.S.shape == (m, m)
        assert (one.nis, one.threshold) == (several.nis[k], several.threshold[k])
        assert (one.weight, one.outcome, one.reason) == (1.0, Outcome.FUSED, "")
    velocities, pressures = several.by_kind()
    assert (velocities.t.tolist(), pressures.t.tolist()) == ([0, 2, 4], [1, 3])
    assert pressures.S.shape == (2, 1)
    np.testing.assert_array_equal(pressures[1].innovation, several[3].innovation)


def test_reports_keep_their_order() -> None:
    broken = UpdateReport(9.0, "baro", "barometer", np.empty(0), np.empty((0, 0)), 1.0, 1.0, 0.0, Outcome.UNSOUND, "!")
    reports = Reports([fused(np.arange(3.0)), broken, fused(np.array([7.0]))])
    assert len(reports) == 5
    assert [one.t for one in reports] == [0, 1, 2, 9, 7]
    assert reports[3] is broken
    assert [one.t for one in reports.of("baro", "barometer")] == [1, 9]
    assert not Reports()
