"""Latency of GNSS as states: of the position, and how much more the velocity lags."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds.ins import CONSUMER, FIELD_N, Flight, feed, flight, imu, magnetometer
from worlds.motion import DT

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.aids.base import OperatingPoint, aid_blocks
from nav.alignment import InitialState
from nav.earth import radii
from nav.error_model import POS, VEL, ErrorModel
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.monitor import MonitoredAid
from nav.reference import Reference
from nav.samples import FixType, GnssSample, ImuSamples
from testbed.motion.table import increments

SIGMA = 0.1  # of the latency [s]
DURATION = 60
FIRST = 91201
RECEIVER = GnssAid(latency_sigma=SIGMA)
AIDS = (RECEIVER, MagnetometerAid())
MODEL = ErrorModel(CONSUMER, aid_blocks(AIDS))
STEPS = {"dv": 1e-2, "dp": 1.0, "gnss_latency": 1e-3}
ACCELERATIONS_N = np.array([[1.5, -4.0, 0.5], [1.0, -5.0, 0.2]])  # averaged once, and twice


def predicted_from(latency, lag, error):
    """Where a fix is predicted from: a state with this latency and lag, to which an ``error`` (n,) is added."""
    attitude, lat, h = Rotation.from_euler("ZYX", [0.3, 0.1, -0.5]), 0.8, 300.0
    v_n = np.array([20.0, 5.0, -2.0]) + error[VEL : VEL + 3]
    R_M, R_N = radii(lat)
    d = error[POS : POS + 3]
    place = lat + d[0] / (R_M + h), 0.1 + d[1] / ((R_N + h) * math.cos(lat)), h - d[2]
    reference = Reference([MODEL], [1.0], 10, lambda *_: FIELD_N)
    state = reference.start(InitialState(0.0, *place, v_n, attitude.as_quat(scalar_first=True), np.eye(9)))
    state.acceleration[:] = ACCELERATIONS_N
    start = MODEL.start("gnss_latency")
    state.x[0, start : start + 2] = latency, lag
    state.x[0, start:] += error[start:]
    starts = tuple(map(MODEL.start, RECEIVER.states))
    return OperatingPoint(reference, state, state.x[0], starts, state.P[0])


@pytest.mark.parametrize("part", ["gnss_position", "gnss_velocity"])
def test_the_jacobian_is_that_of_the_prediction(part):
    sigma = np.full(3, 0.1)
    fix = GnssSample(0.0, 0.0, 0.8, 0.1, 300.0, np.ones(3), 10 * sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
    H = RECEIVER.measure(part, fix, predicted_from(0.07, -0.03, np.zeros(MODEL.size))).H
    for name, step in STEPS.items():
        for column in range(MODEL.slices[name].start, MODEL.slices[name].stop):
            errors = step * np.eye(MODEL.size)[column] * np.array([[1], [-1]])
            plus, minus = (RECEIVER.measure(part, fix, predicted_from(0.07, -0.03, e)).nu for e in errors)
            np.testing.assert_allclose(H[:, column], (minus - plus) / (2 * step), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("lag", [0.1, 0.2, 0.3])
def test_a_velocity_that_lags_is_predicted_to_second_order(lag):
    """It was to first order, by an acceleration 0.2 s old: found latencies were off by 0.026 s where a car weaved."""
    truth, receiver = flight(20), GnssAid(velocity_lag=lag)
    model = ErrorModel(CONSUMER, aid_blocks((receiver,)))
    reference = Reference([model], [1.0], 10, lambda *_: FIELD_N)
    q_nb, v_n = truth.q_nb[0], truth.v_n[0]
    state = reference.start(InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], v_n, q_nb, np.eye(9)))
    starts, ones = tuple(map(model.start, receiver.states)), np.ones(3)
    every, older, off, first_order = 20, round(lag / DT), [], []
    for k in range(every, len(truth.t) - 1, every):
        rows = slice(k - every + 1, k + 1)
        reference.run(state, ImuSamples(truth.t[rows], np.full(every, DT), truth.dtheta[rows], truth.dv[rows]))
        if k < 5 / DT:
            continue
        v = truth.v_n[k - older]
        fix = GnssSample(truth.t[k], truth.t[k], *state.lla, v, ones, ones, FixType.FIX_3D, 10, 1.0, 1.0)
        off.append(
            receiver.measure("gnss_velocity", fix, OperatingPoint(reference, state, state.x[0], starts, state.P[0])).nu
        )
        first_order.append(v - truth.v_n[k] + lag * (truth.v_n[k + 1] - truth.v_n[k - 1]) / (2 * DT))
    assert np.sqrt(np.mean(np.square(off))) < 0.3 * np.sqrt(np.mean(np.square(first_order)))


def late_fixes(truth, rng, latency, lag, rate_hz=2.0):
    """Fixes whose position and velocity are older than their time, by what moves by `SIGMA` from fix to fix."""
    every, samples = round(1 / rate_hz / DT), []
    for k in range(every, len(truth.t), every):
        moves = latency + rng.normal(0.0, SIGMA), latency + lag + rng.normal(0.0, SIGMA)
        p, v = (min(max(k - round(move / DT), 0), len(truth.t) - 1) for move in moves)
        R_M, R_N = radii(truth.lat[p])
        off = 1.5 * rng.normal(size=3)
        samples.append(
            GnssSample(
                truth.t[k], truth.t[k], truth.lat[p] + off[0] / (R_M + truth.h[p]),
                truth.lon[p] + off[1] / ((R_N + truth.h[p]) * math.cos(truth.lat[p])), truth.h[p] - off[2],
                truth.v_n[v] + 0.1 * rng.normal(size=3), np.full(3, 1.5), np.full(3, 0.1), FixType.FIX_3D, 12, 0.8, 1.2,
            )
        )  # fmt: skip
    return samples


def flown(seed, estimator=None, smooth=False, model=CONSUMER, truth=None):
    """What a filter has in the end, and the latency and lag that were drawn."""
    truth, rng = truth or flight(DURATION), np.random.default_rng(seed)
    drawn = SIGMA * rng.normal(size=2)
    increments, *_ = imu(truth, model, rng)
    samples = late_fixes(truth, rng, *drawn)
    samples += magnetometer(truth, rng, MagnetometerAid().bias_sigma * rng.normal(size=3), rate_hz=2.0)
    filter_ = estimator or Ins(InsConfig(model, AIDS, smooth=smooth), lambda *_: FIELD_N)
    estimates, _ = feed(FusionHorizon(filter_), increments, samples, 10.0)
    return filter_, estimates[-1], drawn


@pytest.fixture(scope="module")
def flights():
    """Of each of some draws: the filter, its last estimate, and what was drawn."""
    return [flown(seed, smooth=seed == FIRST) for seed in range(FIRST, FIRST + 8)]


@pytest.fixture(scope="module")
def shaken():
    """The same with accelerometers that are shaken by 0.5 m/s^2 from sample to sample, as small vehicles do."""
    model = replace(CONSUMER, accel_noise=0.5 * math.sqrt(DT))
    return [flown(seed, model=model) for seed in range(FIRST + 100, FIRST + 108)]


@pytest.mark.ci
@pytest.mark.parametrize(("set_of", "share"), [("flights", 1 / 4), ("shaken", 1 / 3)])
def test_a_latency_that_nobody_told_is_found(set_of, share, request):
    """To a ``share`` of what was known before, and as well as is claimed: shaking tells nothing of it."""
    squared = []
    for ins, estimate, drawn in request.getfixturevalue(set_of):
        value, sigma = estimate.extra["gnss_latency"]
        start = ins.model.start("gnss_latency")
        P = ins._state.P[0][start : start + 2, start : start + 2]
        assert (sigma < SIGMA * share).all()
        squared.append((value - drawn) @ np.linalg.solve(P, value - drawn))
    low, high = chi2.ppf([0.005, 0.995], 2 * len(squared)) / (2 * len(squared))
    assert low < np.mean(squared) / 2 < high


def straight(duration_s):
    """25 m/s northward in a line, which the filter's own strapdown flies too."""
    t = np.arange(int(duration_s / DT) + 1) * DT
    h, n = 300.0, len(t)
    lat = 0.8 + 25.0 * t / (radii(0.8)[0] + h)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    rows = t, lat, np.full(n, 0.1), np.full(n, h), np.tile([25.0, 0.0, 0.0], (n, 1)), level
    return Flight(*rows, *increments(*rows))


@pytest.mark.ci
def test_flying_straight_tells_no_latency_and_positions_are_claimed_with_it():
    """How far behind all fixes are by 0.1 s, known to nobody, they agree on: the start by one of them too."""
    _, estimate, _ = flown(FIRST, truth=straight(40.0))
    assert estimate.extra["gnss_latency"][1][0] > 0.95 * SIGMA
    assert math.sqrt(estimate.covariance[0, 0]) > 0.95 * SIGMA * 25.0
    assert math.sqrt(estimate.covariance[1, 1]) < 1.0


@pytest.mark.ci
def test_looking_back_the_latency_was_known_from_the_start(flights):
    ins, estimate, _ = flights[0]
    value, sigma = estimate.extra["gnss_latency"]
    first = next(ins.smoothed([10.0])).extra["gnss_latency"]
    np.testing.assert_allclose(first[0], value, atol=1e-6)
    np.testing.assert_allclose(first[1], sigma, rtol=1e-3)


@pytest.mark.ci
def test_a_federation_finds_what_its_filter_would(flights):
    drawn = flights[0][2]
    locals_ = (
        Local("gnss", (MonitoredAid(RECEIVER), MonitoredAid(MagnetometerAid()))),
        Local("height", (MonitoredAid(BarometerAid()),)),
    )
    federated = Federated(Config(CONSUMER, locals_), lambda *_: FIELD_N)
    value, sigma = flown(FIRST, federated)[1].extra["gnss_latency"]
    assert (np.abs(value - drawn) < 3 * sigma).all()
    assert (sigma < SIGMA / 2).all()


def test_an_exact_latency_is_no_state():
    assert "gnss_latency" not in ErrorModel(CONSUMER, aid_blocks((GnssAid(),))).slices
