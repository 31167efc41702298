"""The heading of what hovers and manoeuvres without a compass: found, honest, and not found where there is nothing."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.federated import true_start
from worlds.ins import DEG, Flight, barometer, error, feed, gnss, imu

from nav.aids import BarometerAid, GnssAid
from nav.earth import radii
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.velocity_matching import AT_BEST, VelocityMatching
from testbed.motion.table import increments

HOBBY = ImuModel(
    gyro_noise=0.6 * DEG / 60, accel_noise=0.2 / 60, gyro_bias_sigma=0.5 * DEG, accel_bias_sigma=0.2,
    gyro_bias_walk=1e-5, accel_bias_walk=1e-4, gyro_motion=0.01, accel_motion=0.01,
)  # fmt: skip
G = np.array([0.0, 0.0, 9.8])
RATE_HZ = 200


def pairs(rng, count, seconds=2.0, strength=1.0, noise=0.1, gyro=0.0, accel=0.0, turning=0.2):
    """Pairs of a body that swings and turns, the biases drawn; the true C_nb at the end. Made by small steps."""
    steps = 40
    dt = seconds / steps
    heading, b, a = rng.uniform(-math.pi, math.pi), gyro * rng.normal(size=3), accel * rng.normal(size=3)
    made, phases = [], rng.uniform(0, 6, (3, 2))

    def attitude(t):
        swing = 0.15 * np.sin(np.outer(t, [0.7, 0.45]) + phases[0])
        return Rotation.from_euler("ZYX", np.column_stack([heading + turning * t, swing]))

    t = (np.arange(count * steps) + 0.5) * dt
    wave = np.sin(np.outer(t, [0.8, 1.1, 0.3]) + phases[1, 0] + np.arange(3) * phases[2, 1])
    f_n = strength * wave * [1.0, 1.0, 0.3] - G
    f_b = attitude(t).inv().apply(f_n) + a
    turns = (attitude(t - dt / 2).inv() * attitude(t + dt / 2)).as_rotvec() + b * dt
    whole, half = Rotation.from_rotvec(turns).as_matrix(), Rotation.from_rotvec(turns / 2).as_matrix()
    for k in range(count):
        C_1b, push_1, turned_1 = np.eye(3), np.zeros(3), np.zeros((3, 3))
        for i in range(k * steps, (k + 1) * steps):
            middle = C_1b @ half[i]
            push_1, turned_1 = push_1 + middle @ f_b[i] * dt, turned_1 + middle * dt
            C_1b = C_1b @ whole[i]
        push_n = f_n[k * steps : (k + 1) * steps].sum(axis=0) * dt + noise * rng.normal(size=3)
        made.append((C_1b, push_1, turned_1, seconds, push_n, max(noise, 1e-3)))
    return made, attitude(np.array([count * seconds]))[0]


def matched(made, gyro=1e-4, accel=1e-3):
    found = VelocityMatching(gyro, accel)
    for pair in made:
        found.add(*pair)
    attitude = found.attitude()
    return None if attitude is None else (attitude.C_nb[0], math.sqrt(attitude.covariance[2, 2]))


def off(found, true):
    """Azimuth [rad] of what is thought to be north."""
    east, north = true.apply(found[0])[1::-1]
    return math.atan2(east, north)


@pytest.mark.parametrize("seed", range(8))
def test_without_noise_it_is_exact_whatever_the_heading_and_the_biases(seed):
    rng = np.random.default_rng(seed)
    made, true = pairs(rng, 12, noise=0.0, gyro=0.5 * DEG, accel=0.1)
    found = matched(made, 0.5 * DEG, 0.1)
    assert found is not None
    assert abs(off(found, true)) < 0.02
    assert found[1] < 1.1 * AT_BEST


@pytest.mark.ci
def test_it_is_as_good_as_it_says():
    """It says more than noise makes: what nobody knows of latency and scale, `AT_BEST`, is not drawn here."""
    wrong, claimed = [], []
    for seed in range(60):
        rng = np.random.default_rng(100 + seed)
        made, true = pairs(rng, 15, strength=0.6, noise=0.25, gyro=0.5 * DEG, accel=0.1)
        found = matched(made, 0.5 * DEG, 0.1)
        if found is not None:
            wrong.append(off(found, true))
            claimed.append(math.sqrt(found[1] ** 2 - AT_BEST**2))
    assert len(wrong) > 40
    nees = np.square(np.divide(wrong, claimed))
    print(f"{len(wrong)} of 60, {np.degrees(np.sqrt(np.mean(np.square(wrong)))):.1f} deg, NEES {nees.mean():.2f}")
    assert 0.4 < nees.mean() < 2.5  # few degrees of freedom tell how large residuals are: heavier tails than chi-square
    assert np.abs(np.divide(wrong, np.hypot(claimed, AT_BEST))).max() < 3.0


def pulled(seed, noise):
    """Fifteen pairs of a receiver that is led away steadily, by 2 m/s^2 an axis (rms)."""
    rng = np.random.default_rng(seed)
    made, true = pairs(rng, 15, strength=2.0, noise=noise, gyro=0.1 * DEG, accel=0.05)
    away = rng.normal(size=3) * 2.0
    return [(*one[:4], one[4] + away * one[3], one[5]) for one in made], true


def turn_off(made, true, pull_sigma):
    """The turn (3,) [rad] by which the attitude found is off, and its covariance less what is not drawn here."""
    found = VelocityMatching(0.1 * DEG, 0.05, pull_sigma)
    for pair in made:
        found.add(*pair)
    attitude = found.attitude()
    if attitude is None:
        return None
    off_n = (Rotation.from_matrix(attitude.C_nb) * true.inv()).as_rotvec()
    return off_n, attitude.covariance - np.diag([0.0, 0.0, AT_BEST**2])


@pytest.mark.ci
def test_a_steady_pull_is_told_from_a_tilt():
    """Where more than gravity is felt: without noise to two degrees, and as well as it says with it."""
    exact = [turn_off(*pulled(400 + seed, 0.0), 2.0) for seed in range(12)]
    assert max(np.abs(one[0]).max() for one in exact) < 0.03
    tilted = [turn_off(*pulled(400 + seed, 0.0), 0.0) for seed in range(12)]
    assert all(one is None or np.abs(one[0][:2]).max() > 0.03 for one in tilted)
    told = [one for seed in range(60) if (one := turn_off(*pulled(500 + seed, 0.2), 2.0)) is not None]
    assert len(told) > 40
    nees = [turn @ np.linalg.solve(covariance, turn) / 3 for turn, covariance in told]
    print(f"{len(told)} of 60, NEES {np.mean(nees):.2f}")
    assert 0.4 < np.mean(nees) < 2.5


@pytest.mark.ci
@pytest.mark.parametrize("strength", [0.0, 0.05])
def test_noise_tells_nothing(strength):
    """A hovering body, and a receiver that is wrong by more than it moves."""
    for seed in range(60):
        rng = np.random.default_rng(200 + seed)
        made, _ = pairs(rng, 15, strength=strength, noise=0.2, gyro=0.5 * DEG, accel=0.1)
        assert matched(made, 0.5 * DEG, 0.1) is None


@pytest.mark.parametrize("weight", [9.8, 0.0])
def test_without_any_error_or_in_free_fall_there_is_nothing_to_tell_either(weight):
    """At rest, where no turn about the vertical makes a difference; and where no direction is told at all."""
    rng = np.random.default_rng(0)
    still = np.array([0.0, 0.0, -2 * weight])
    with np.errstate(all="ignore"):
        made = [(np.eye(3), still, 2 * np.eye(3), 2.0, still + 0.3 * rng.normal(size=3), 0.3) for _ in range(15)]
        assert matched(made, 1e-6, 1e-6) is None
        assert matched([(*one[:4], one[1], 0.3) for one in made], 1e-6, 1e-6) is None


def test_velocities_that_are_worse_than_told_are_not_believed():
    made = []
    for seed in range(40):
        rng = np.random.default_rng(300 + seed)
        one, true = pairs(rng, 15, strength=0.4, noise=0.0)
        found = matched([(*pair[:4], pair[4] + 0.6 * rng.normal(size=3), 0.1) for pair in one])
        made.append(found is not None and abs(off(found, true)) > 3 * found[1])
    assert sum(made) <= 1


def test_a_broken_chain_is_forgotten():
    made, _ = pairs(np.random.default_rng(0), 12)
    found = VelocityMatching(1e-4, 1e-3)
    for pair in made:
        found.add(*pair)
    assert found.attitude() is not None
    found.forget()
    assert found.attitude() is None


def hovering(seconds, rng, strength=1.2):
    """A small vehicle that flies to and fro at less than 8 m/s, tilted as its acceleration needs."""
    t = np.arange(int(seconds * RATE_HZ) + 1) / RATE_HZ
    w, phase = rng.uniform(0.3, 0.9, (2, 3)), rng.uniform(0, 6, (2, 3))
    a = np.zeros((len(t), 3))
    v = np.zeros((len(t), 3))
    for axis in range(2):
        for k in range(3):
            a[:, axis] += strength / 2 * np.sin(w[axis, k] * t + phase[axis, k])
            v[:, axis] -= strength / 2 / w[axis, k] * np.cos(w[axis, k] * t + phase[axis, k])
    heading = rng.uniform(-math.pi, math.pi) + 0.3 * np.sin(0.2 * t)
    thrust = a - G
    down = -thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    ahead = np.column_stack([np.cos(heading), np.sin(heading), 0 * t])
    right = np.cross(down, ahead)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    C = np.stack([np.cross(right, down), right, down], axis=2)
    h = np.full(len(t), 300.0)
    R_M, R_N = radii(48 * DEG)
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) / RATE_HZ, axis=0)])
    lat, lon = 48 * DEG + way[:, 0] / (R_M + 300), 11 * DEG + way[:, 1] / ((R_N + 300) * math.cos(48 * DEG))
    q = Rotation.from_matrix(C).as_quat(scalar_first=True)
    q *= np.where(np.r_[False, np.cumsum(np.sum(q[1:] * q[:-1], axis=1) < 0) % 2 == 1], -1.0, 1.0)[:, None]
    rows = t, lat, lon, h, v, q
    return Flight(*rows, *increments(*rows))


@pytest.mark.ci
@pytest.mark.parametrize("seed", range(3))
def test_a_filter_without_a_compass_finds_its_heading_below_the_speed_of_the_course(seed):
    rng = np.random.default_rng(400 + seed)
    truth = hovering(60, rng)
    assert np.linalg.norm(truth.v_n, axis=1).max() < 8.0
    made, *_ = imu(truth, HOBBY, rng)
    told = []
    for cut in (0.5, 10.0):  # and the same bits, however it is cut
        ins = Ins(InsConfig(HOBBY, (GnssAid(), BarometerAid())))
        told.append(feed(FusionHorizon(ins), made, gnss(truth, np.random.default_rng(seed), 5.0), cut)[0])
    known = [one for one in told[0] if math.isfinite(one.lat)]
    assert known[0].t < 45
    for one in known:
        wrong, sigma = error(one, truth), np.sqrt(np.diag(one.covariance))
        assert (np.abs(wrong) < 5.5 * sigma).all(), one.t
    assert abs(error(known[-1], truth)[8]) < 10 * DEG
    by_time = {round(one.t, 3): one for one in told[0]}
    for one in told[1]:
        assert np.array_equal(one.q_nb, by_time[round(one.t, 3)].q_nb, equal_nan=True)


@pytest.mark.ci
@pytest.mark.parametrize("gap_s", [2.0, 10.0, 30.0])
@pytest.mark.parametrize("seed", [700, 701])
def test_after_a_gap_it_waits_for_its_heading_and_is_not_too_sure(gap_s, seed):
    """Corrected along wrong axes while it waited, one was 90 m off at a claim of metres, and kept to it."""
    rng = np.random.default_rng(seed)
    truth = hovering(100 + gap_s, rng)
    made, *_ = imu(truth, HOBBY, rng)
    lost = (made.t > 60) & (made.t <= 60 + gap_s)
    made.dtheta[lost] = made.dv[lost] = np.nan
    ins = Ins(InsConfig(HOBBY, (GnssAid(), BarometerAid())))
    ins.start(true_start(truth))
    samples = gnss(truth, np.random.default_rng(seed), 5.0) + barometer(truth, np.random.default_rng(seed))
    for one in feed(FusionHorizon(ins), made, samples, 1.0)[0]:
        wrong, sigma = error(one, truth), np.sqrt(np.diag(one.covariance))
        assert (np.abs(wrong) < 5.5 * sigma).all(), one.t
        if one.t > 60 + gap_s + 0.5:  # where the receiver is, whatever the heading
            assert np.hypot(*wrong[:2]) < 10.0
        if one.t > 60 + gap_s + 25:
            assert np.hypot(*wrong[:2]) < 2.0
            assert abs(wrong[8]) < 10 * DEG


def test_an_antenna_that_swings_is_reckoned_with():
    rng = np.random.default_rng(5)
    truth, arm_b = hovering(60, rng), (-3.0, 0.0, 0.0)
    made, *_ = imu(truth, HOBBY, rng)
    ins = Ins(InsConfig(HOBBY, (GnssAid(arm_b=arm_b), BarometerAid())))
    estimates, _ = feed(FusionHorizon(ins), made, gnss(truth, rng, 5.0, arm_b=arm_b), 1.0)
    known = [one for one in estimates if math.isfinite(one.lat)]
    assert known[0].t < 30
    assert abs(error(known[0], truth)[8]) < 15 * DEG


def test_a_slow_receiver_tells_it_too():
    """Each 5 s; with outages of 20 s, which the gyros bridge."""
    rng = np.random.default_rng(6)
    truth = hovering(150, rng)
    made, *_ = imu(truth, HOBBY, rng)
    ins = Ins(InsConfig(HOBBY, (GnssAid(), BarometerAid())))
    fixes = [one for one in gnss(truth, rng, 0.2) if not 20 < one.t < 40]
    estimates, _ = feed(FusionHorizon(ins), made, fixes, 10.0)
    known = [one for one in estimates if math.isfinite(one.lat)]
    assert known[0].t < 100
    assert abs(error(known[0], truth)[8]) < 3 * math.sqrt(known[0].covariance[8, 8])


def test_one_that_hovers_still_says_what_it_waits_for():
    rng = np.random.default_rng(1)
    truth = hovering(40, rng, strength=0.0)
    made, *_ = imu(truth, HOBBY, rng)
    ins = Ins(InsConfig(HOBBY, (GnssAid(), BarometerAid())))
    feed(FusionHorizon(ins), made, gnss(truth, rng, 5.0), 1.0)
    assert not ins.aligned
    assert "accelerations that tell the heading" in ins.problem


def test_a_lost_increment_breaks_the_chain():
    rng = np.random.default_rng(2)
    truth = hovering(60, rng)
    made, *_ = imu(truth, HOBBY, rng)
    broken = dataclasses.replace(made, dtheta=np.where(np.abs(made.t - 12.0)[:, None] < 0.01, np.nan, made.dtheta))
    aligned = []
    for one in (made, broken):
        ins = Ins(InsConfig(HOBBY, (GnssAid(), BarometerAid())))
        estimates, _ = feed(FusionHorizon(ins), one, gnss(truth, np.random.default_rng(3), 5.0), 0.5)
        aligned.append(next(e.t for e in estimates if math.isfinite(e.lat)))
    assert aligned[0] >= 12
    assert aligned[1] >= 12 + 12
