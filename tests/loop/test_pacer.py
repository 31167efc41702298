import pytest

from testbed.errors import UserError
from testbed.loop.pacer import MAX_LAG_S, Pacer


class Clock:
    """A clock that sleeping moves, and that oversleeps by ``over`` each time, as real ones do."""

    def __init__(self, over: float = 0.0) -> None:
        self.now = 1000.0
        self.over = over

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds + self.over


def pacer(clock: Clock, factor: float = 1.0) -> Pacer:
    return Pacer(factor, clock=clock, sleep=clock.sleep)


@pytest.mark.parametrize("factor", [0.5, 1.0, 20.0])
def test_an_hour_does_not_drift_though_every_sleep_is_too_long(factor):
    clock = Clock(over=0.0003)
    paced = pacer(clock, factor)
    for k in range(90_001):
        paced.wait(k * 0.04)
        clock.now += 0.0001  # the run's own work
    assert clock.now - 1000.0 == pytest.approx(3600 / factor, abs=0.001)
    assert paced.missed == 0
    assert paced.waits == 90_000


def test_first_call_sets_the_start_whatever_the_time():
    clock = Clock()
    paced = pacer(clock)
    paced.wait(120.0)
    assert clock.now == 1000.0
    paced.wait(121.5)
    assert clock.now == pytest.approx(1001.5)


def test_a_short_delay_is_made_good():
    clock = Clock()
    paced = pacer(clock)
    paced.wait(0.0)
    clock.now += 0.3
    paced.wait(0.1)  # 0.2 s late
    assert clock.now == pytest.approx(1000.3)
    paced.wait(1.0)
    assert clock.now == pytest.approx(1001.0)
    assert paced.missed == 1
    assert paced.worst_s == pytest.approx(0.2)
    assert paced.given_up_s == 0.0


def test_a_long_delay_is_made_good_only_in_part():
    clock = Clock()
    paced = pacer(clock)
    paced.wait(0.0)
    clock.now += 10.0  # suspended
    paced.wait(1.0)  # 9 s late
    assert paced.given_up_s == pytest.approx(9.0 - MAX_LAG_S)
    assert str(paced) == "real time: 1 of 1 deadlines missed, at worst by 9 s; 8.5 s not made good"
    before = clock.now
    paced.wait(2.0)
    assert clock.now - before == pytest.approx(1.0 - MAX_LAG_S)
    before = clock.now
    paced.wait(3.0)
    assert clock.now - before == pytest.approx(1.0)


def test_a_run_too_slow_for_its_factor_never_sleeps_and_never_falls_behind_more_than_the_bound():
    clock = Clock()
    paced = pacer(clock, 10.0)
    for k in range(101):
        paced.wait(float(k))
        clock.now += 0.5  # 0.1 s allowed
    assert paced.missed == 100
    assert paced.worst_s <= MAX_LAG_S + 0.4 + 1e-9
    assert clock.now == pytest.approx(1000.0 + 101 * 0.5)


def test_on_the_real_clock():
    import time

    paced = Pacer(10.0)
    start = time.monotonic()
    for k in range(51):
        paced.wait(k * 0.04)
    assert time.monotonic() - start >= 0.2  # that waits don't add up is shown above, on a clock that nothing delays


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_factor(factor):
    with pytest.raises(UserError, match="above 0"):
        Pacer(factor)


def test_a_pause_and_a_new_speed_move_the_deadlines():
    clock = Clock()
    paced = pacer(clock)
    paced.wait(0.0)
    paced.wait(1.0)
    clock.now += 100.0  # paused
    paced.restart(1.0)
    before = clock.now
    paced.wait(2.0)
    assert clock.now - before == pytest.approx(1.0)
    paced.restart(2.0, 4.0)
    paced.wait(4.0)
    assert clock.now - before == pytest.approx(1.5)
    assert paced.missed == 0
    assert paced.given_up_s == 0.0


def test_jitter_is_how_late_a_wait_is_over():
    clock = Clock()
    paced = pacer(clock)
    paced.wait(0.0)
    for k in range(1, 1001):
        clock.over = 0.00305 if k % 50 == 0 else 0.00015  # 2 % of the sleeps are too long
        paced.wait(k * 0.04)
    assert paced.jitter_s(0.5) == pytest.approx(0.0002)
    assert paced.jitter_s(0.98) == pytest.approx(0.0002)
    assert paced.jitter_s(0.99) == pytest.approx(0.0031)
    clock.now += 3600.0
    paced.wait(41.0)
    assert paced.jitter_s(1.0) == pytest.approx(0.5), "as far as is counted"


def test_spare_time_is_offered_and_what_is_left_is_slept():
    clock = Clock()
    paced = pacer(clock)
    offered = []

    def meanwhile(seconds):
        offered.append(seconds)
        clock.now += 0.03

    paced.wait(0.0, meanwhile)
    paced.wait(0.1, meanwhile)
    assert clock.now == pytest.approx(1000.1)
    clock.now += 0.09
    paced.wait(0.2, meanwhile)  # which takes longer than was offered
    assert clock.now == pytest.approx(1000.22)
    clock.now += 1.0
    paced.wait(0.3, meanwhile)
    assert offered == [pytest.approx(0.1), pytest.approx(0.01)]
    assert paced.missed == 1
