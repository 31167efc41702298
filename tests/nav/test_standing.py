"""A vehicle that stands is known to by what its IMU feels, once a receiver has said so; one that moves never is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from nav.aids import ZeroVelocityAid
from nav.aids.base import OperatingPoint
from nav.error_model import VEL
from nav.reference import Reference
from nav.samples import Array, BodyVelocitySample, FixType, GnssSample, ImuSamples
from nav.standing import WINDOW_S, ZERO_VELOCITY, Standing
from nav.state import State

RATE_HZ = 50
GRAVITY = 9.81
BIAS = np.array([[0.01, -0.02, 0.005], [0.2, -0.1, 0.3]])  # [rad/s], [m/s^2]


def felt(seconds: int, forward: Array | None = None, shaken: tuple[float, float] = (0.002, 0.02)) -> ImuSamples:
    """Increments of a level vehicle with an acceleration ``forward`` (N,) [m/s^2], its rates white of these rms."""
    random = np.random.default_rng(1)
    n = seconds * RATE_HZ
    gyro, accel = (bias + rms * random.standard_normal((n, 3)) for bias, rms in zip(BIAS, shaken, strict=True))
    accel[:, 2] -= GRAVITY
    accel[:, 0] += 0.0 if forward is None else forward
    dt = np.full(n, 1 / RATE_HZ)
    return ImuSamples((1 + np.arange(n)) / RATE_HZ, dt, gyro * dt[:, None], accel * dt[:, None])


def fix(t: float, speed: float = 0.1, delay: float = 0.2) -> GnssSample:
    """One that arrives ``delay`` [s] later."""
    v_n, sigma = np.array([0.0, speed, 0.0]), np.full(3, 0.1)
    return GnssSample(t, t + delay, 0.8, 0.1, 300.0, v_n, np.full(3, 2.0), sigma, FixType.FIX_3D, 12, 0.9, 1.4, "gnss")


def times(told: Sequence[BodyVelocitySample]) -> list[float]:
    """Of the windows in which it stood, as whole numbers."""
    assert all(one.t == one.t_arrival and one.sensor == ZERO_VELOCITY and not one.v_b.any() for one in told)
    return [round(one.t, 6) for one in told]


def blocks(standing: Standing, imu: ImuSamples, fixes: Sequence[GnssSample], cuts: Sequence[int]) -> list[float]:
    """What it tells when increments come in blocks and fixes as they arrive."""
    told, left = [], sorted(fixes, key=lambda one: one.t_arrival)
    for rows in np.split(np.arange(len(imu)), list(cuts)):
        block = ImuSamples(imu.t[rows], imu.dt[rows], imu.dtheta[rows], imu.dv[rows])
        until = imu.t[rows[-1]] if len(rows) else -np.inf
        arrived = [one for one in left if one.t_arrival <= until]
        left = [one for one in left if one.t_arrival > until]
        told += standing.heard(block, arrived)
    return times(told)


def test_once_a_fix_says_so_it_stands_until_it_is_moved() -> None:
    push = np.zeros(60 * RATE_HZ)
    push[40 * RATE_HZ :] = 1.0
    told = Standing((0.0, 0.0)).heard(felt(60, push), [fix(10.3)])
    assert times(told) == list(range(11, 41))
    assert pytest.approx(1.0) == WINDOW_S


def test_blocks_make_no_difference() -> None:
    random = np.random.default_rng(2)
    imu, fixes = felt(60), [fix(t, 0.1 if t < 30 else 3.0) for t in (5.0, 29.9, 30.2)]
    whole = times(Standing((0.0, 0.0)).heard(imu, fixes))
    assert whole == list(range(6, 31))  # the moving fix arrives at 30.4 s
    for _ in range(5):
        cuts = np.sort(random.integers(0, len(imu), 40))
        assert blocks(Standing((0.0, 0.0)), imu, fixes, cuts.tolist()) == whole


def test_without_a_fix_and_in_smooth_flight_nothing_is_told() -> None:
    assert Standing((0.0, 0.0)).heard(felt(60), []) == []
    assert Standing((0.0, 0.0)).heard(felt(60), [fix(t, 25.0) for t in range(60)]) == []
    no_velocity = fix(3.0)
    no_velocity.v_n[:] = np.nan
    assert Standing((0.0, 0.0)).heard(felt(60), [no_velocity]) == []


@pytest.mark.parametrize("acceleration", [0.15, 0.3, 1.0, 5.0])
def test_set_in_motion_gently_it_is_known_to_move_before_it_is_fast(acceleration: float) -> None:
    """Without fixes: the acceleration sets in over four seconds, and no window shakes more than at rest."""
    t = np.arange(60 * RATE_HZ) / RATE_HZ
    forward = acceleration * np.clip((t - 20.5) / 4, 0, 1)
    speed = np.cumsum(forward) / RATE_HZ
    told = times(Standing((0.0, 0.0)).heard(felt(60, forward), [fix(2.0)]))
    assert told[:18] == list(range(3, 21))
    assert speed[round(told[-1] * RATE_HZ) - 1] < 0.3


@pytest.mark.parametrize("acceleration", [0.15, 0.25, 1.0])
@pytest.mark.parametrize("told_until", [10.3, 60.0])
def test_who_moves_off_steadily_does_not_stand_by_a_fix_of_before(acceleration: float, told_until: float) -> None:
    """What was felt a window later was taken for what is felt at rest, and told for the rest of an outage."""
    push = np.where(np.arange(60 * RATE_HZ) < 10 * RATE_HZ, 0.0, acceleration)
    fixes = [fix(t, acceleration * max(t - 10.0, 0.0)) for t in np.arange(1.0, told_until, 0.2).tolist()]
    assert times(Standing((0.0, 0.0)).heard(felt(60, push), fixes)) == list(range(2, 11))


def test_a_running_engine_a_missing_and_a_broken_increment_are_no_rest() -> None:
    assert Standing((0.0, 0.0)).heard(felt(30, shaken=(0.05, 0.3)), [fix(2.0)]) == []
    broken = felt(30)
    broken.dv[20 * RATE_HZ + 3] = np.nan
    assert times(Standing((0.0, 0.0)).heard(broken, [fix(2.0)])) == list(range(3, 21))
    imu = felt(30)
    here = (imu.t < 20.01) | (imu.t > 23)
    gap = ImuSamples(imu.t[here], imu.dt[here], imu.dtheta[here], imu.dv[here])
    assert times(Standing((0.0, 0.0)).heard(gap, [fix(2.0)])) == list(range(3, 21))
    short = (imu.t < 20.01) | (imu.t > 20.3)  # of one window a third is missing
    cut = ImuSamples(imu.t[short], imu.dt[short], imu.dtheta[short], imu.dv[short])
    assert times(Standing((0.0, 0.0)).heard(cut, [fix(2.0)])) == list(range(3, 21))
    again = times(Standing((0.0, 0.0)).heard(gap, [fix(2.0), fix(25.1), fix(27.1)]))
    assert again == [*range(3, 21), *range(28, 31)]


def test_a_noisy_imu_stands_when_its_noise_is_told() -> None:
    noise = (0.05, 0.5)  # rms of its rates at 50 Hz
    density = tuple(rms / RATE_HZ**0.5 for rms in noise)
    assert Standing((0.0, 0.0)).heard(felt(30, shaken=noise), [fix(2.0)]) == []
    assert times(Standing((density[0], density[1])).heard(felt(30, shaken=noise), [fix(2.0)])) == list(range(3, 31))


def test_zero_velocity_is_minus_the_velocity_and_tells_of_nothing_else() -> None:
    state, x = State(15, 1, 15), np.zeros(15)
    state.v_n[:] = 1.0, -2.0, 0.5
    aid = ZeroVelocityAid(ZERO_VELOCITY, 0.1)
    reference: Reference = None  # type: ignore[assignment]  # it asks nothing of it
    sample = BodyVelocitySample(0.0, 0.0, np.zeros(3), ZERO_VELOCITY)
    found = aid.measure("zero_velocity", sample, OperatingPoint(reference, state, x, (), np.eye(15)))
    assert found is not None
    assert found.nu.tolist() == [-1.0, 2.0, -0.5]
    np.testing.assert_allclose(found.R, [0.01] * 3)
    step = np.zeros(15)  # an error state is what is to be added: v + dv = 0 takes dv = nu
    step[VEL : VEL + 3] = found.nu
    np.testing.assert_array_equal(found.H @ step, found.nu)
    assert np.count_nonzero(found.H) == 3
