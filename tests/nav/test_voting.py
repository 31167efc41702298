"""Redundant inertial units: sound ones are averaged, a faulty one is found, two alone only disagree."""

import dataclasses
import math

import numpy as np
import pytest
from worlds.ins import CONSUMER, flight, imu

from nav.samples import ImuSamples
from nav.voting import Voter


def units(count, seed=0, duration=30):
    truth = flight(duration)
    rng = np.random.default_rng(seed)
    return truth, [imu(truth, CONSUMER, rng)[0] for _ in range(count)]


def faulty(block, start, stop, dv=0.0, dtheta=0.0):
    """An accelerometer x fault [m/s^2] or a gyro z fault [rad/s] over a span."""
    during = (block.t > start) & (block.t <= stop)
    dv_b, dtheta_b = block.dv.copy(), block.dtheta.copy()
    dv_b[during, 0] += dv * block.dt[during]
    dtheta_b[during, 2] += dtheta * block.dt[during]
    return dataclasses.replace(block, dv=dv_b, dtheta=dtheta_b)


def test_sound_units_are_averaged():
    truth, blocks = units(3)
    mean, ballots = Voter(CONSUMER).vote(blocks)
    np.testing.assert_allclose(mean.dv, sum(b.dv for b in blocks) / 3, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(mean.dtheta, sum(b.dtheta for b in blocks) / 3, rtol=1e-12, atol=1e-15)
    assert len(ballots) == 150
    assert not any(any(b.failed) or b.ambiguous for b in ballots)
    spread = [np.std((b.dv - truth.dv[1:])[:, 1]) for b in (mean, *blocks)]
    assert spread[0] == pytest.approx(np.mean(spread[1:]) / math.sqrt(3), rel=0.05)


def test_statistic_is_chi_square_of_six():
    """Biases drawn anew for each of 300 sets of three units: the mean is six, and 1 % are over the 1 % limit."""
    rng = np.random.default_rng(1)
    values = []
    t, dt = np.arange(1, 41) * 0.005, np.full(40, 0.005)
    still = np.zeros((40, 3))
    for _ in range(600):
        blocks = [
            ImuSamples(
                t, dt,
                still + rng.normal(size=3) * CONSUMER.gyro_bias_sigma * 0.005
                + rng.normal(size=(40, 3)) * CONSUMER.gyro_noise * math.sqrt(0.005),
                still + rng.normal(size=3) * CONSUMER.accel_bias_sigma * 0.005
                + rng.normal(size=(40, 3)) * CONSUMER.accel_noise * math.sqrt(0.005),
            )
            for _ in range(3)
        ]  # fmt: skip
        (ballot,) = Voter(CONSUMER, false_alarm=1e-12).vote(blocks)[1]
        values.extend(ballot.statistic)
    assert np.mean(values) == pytest.approx(6.0, abs=0.35)
    assert np.mean(np.array(values) > 16.81) == pytest.approx(0.01, abs=0.008)


@pytest.mark.parametrize("fault", [{"dv": 0.5}, {"dtheta": math.radians(1.0)}])
def test_the_faulty_one_of_three_is_isolated_and_readmitted(fault):
    _, blocks = units(3)
    voter = Voter(CONSUMER)
    mean, ballots = voter.vote([blocks[0], faulty(blocks[1], 10, 15, **fault), blocks[2]])
    out = [b.t for b in ballots if b.failed == (False, True, False)]
    assert out[0] == pytest.approx(10.2)
    assert out[-1] == pytest.approx(15.0 + 24 * 0.2)  # 25 windows in succession were sound
    assert len(out) == round((out[-1] - out[0]) / 0.2) + 1
    during = (mean.t > 10.3) & (mean.t < 19)
    np.testing.assert_allclose(mean.dv[during], 0.5 * (blocks[0].dv + blocks[2].dv)[during], rtol=1e-12)
    assert not any(b.ambiguous for b in ballots)


def test_of_two_none_can_be_blamed():
    _, blocks = units(2)
    mean, ballots = Voter(CONSUMER).vote([blocks[0], faulty(blocks[1], 10, 15, dv=1.0)])
    assert [round(b.t, 1) for b in ballots if b.ambiguous] == [round(10.2 + 0.2 * k, 1) for k in range(25)]
    assert not any(any(b.failed) for b in ballots)
    np.testing.assert_allclose(mean.dtheta, 0.5 * (blocks[0].dtheta + blocks[1].dtheta), rtol=1e-12, atol=1e-18)


def test_two_of_four_fail_after_each_other():
    _, blocks = units(4)
    blocks[0] = faulty(blocks[0], 5, 30, dv=0.5)
    blocks[3] = faulty(blocks[3], 12, 30, dtheta=0.02)
    _, ballots = Voter(CONSUMER).vote(blocks)
    assert ballots[-1].failed == (True, False, False, True)
    assert [b.failed for b in ballots if b.t < 11.9][-1] == (True, False, False, False)


def test_an_increment_that_is_no_number_is_left_out_at_once():
    _, blocks = units(3)
    blocks[2].dv[2000:2004] = math.nan
    mean, ballots = Voter(CONSUMER).vote(blocks)
    assert np.isfinite(mean.dv).all()
    np.testing.assert_allclose(mean.dv[2001], 0.5 * (blocks[0].dv[2001] + blocks[1].dv[2001]), rtol=1e-12)
    assert any(b.failed == (False, False, True) for b in ballots)
    assert ballots[-1].failed == (False, False, False)
    for block in blocks:
        block.dv[3000] = math.nan
    mean, ballots = Voter(CONSUMER).vote(blocks)
    assert np.isnan(mean.dv[3000]).all()
    assert ballots[-1].failed == (False, False, False)


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e300, -1e9])
def test_nor_is_one_that_cant_be(value):
    _, (good, bad, other) = units(3, duration=3)
    during = (bad.t > 1.0) & (bad.t <= 2.0)
    spoilt = dataclasses.replace(bad, dtheta=np.where(during[:, None], value, bad.dtheta))
    used, ballots = Voter(CONSUMER).vote([good, spoilt, other])
    np.testing.assert_allclose(used.dtheta[during], (good.dtheta + other.dtheta)[during] / 2, rtol=1e-12)
    assert [b.failed for b in ballots if 1.1 < b.t < 2.1] == [(False, True, False)] * 5


def test_blocks_of_any_size_give_the_same_bits():
    _, blocks = units(3)
    blocks[1] = faulty(blocks[1], 10, 15, dv=0.5)
    whole, ballots = Voter(CONSUMER).vote(blocks)
    voter, parts, counted = Voter(CONSUMER), [], []
    for start in range(0, len(whole), 37):
        rows = slice(start, start + 37)
        part, some = voter.vote([ImuSamples(b.t[rows], b.dt[rows], b.dtheta[rows], b.dv[rows]) for b in blocks])
        parts.append(part.dv)
        counted += some
    np.testing.assert_array_equal(np.vstack(parts), whole.dv)
    assert [b.failed for b in counted] == [b.failed for b in ballots]


def test_units_out_of_step_are_refused():
    _, blocks = units(2)
    late = dataclasses.replace(blocks[1], t=blocks[1].t + 0.005)
    with pytest.raises(ValueError, match="same times"):
        Voter(CONSUMER).vote([blocks[0], late])
