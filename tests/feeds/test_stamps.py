"""Times as logs have them are put in order, and increments made of them leave nothing out."""

from __future__ import annotations

import time

import numpy as np
import pytest

from nav.samples import ImuSamples
from testbed.feeds.stamps import Loss, at_times, begun, bridged, integrated, ordered

T = np.arange(1, 401) / 50


def steady(t: np.ndarray) -> ImuSamples:
    return integrated(t, np.full((len(t), 3), 0.1), np.full((len(t), 3), -9.8), "averaged")


def test_times_in_order_are_left_as_they_are() -> None:
    notes: list[str] = []
    t, rows = ordered("imu", T, notes)
    assert np.array_equal(t, T)
    assert np.array_equal(rows, np.arange(len(T)))
    assert notes == []


@pytest.mark.parametrize("wrap", [2**32 * 1e-6, 2**16 * 1e-3, 604_800.0, 86_400.0])
def test_a_counter_that_wraps_goes_on(wrap: float) -> None:
    notes: list[str] = []
    t, rows = ordered("imu", (T + wrap - 4) % wrap, notes)
    assert np.allclose(t, T + wrap - 4, rtol=0, atol=1e-6)
    assert len(rows) == len(T)
    assert [note for note in notes if "began anew" in note]


@pytest.mark.parametrize("wrap", [2**32 * 1e-6, 2**16 * 1e-3, 604_800.0, 86_400.0])
@pytest.mark.parametrize("moved", [4.0, -300.0, 1e6])
def test_a_counter_that_wraps_goes_on_where_its_times_were_moved(wrap: float, moved: float) -> None:
    """As less its first, or by an offset that a scenario gives."""
    notes: list[str] = []
    t, rows = ordered("gnss", (T + wrap - 4) % wrap - wrap + moved, notes)
    assert np.allclose(t, T - 4 + moved, rtol=0, atol=1e-6)
    assert len(rows) == len(T)
    assert [note for note in notes if "began anew" in note]


def test_disorder_and_repeats_are_mended_and_told() -> None:
    stamps = T.copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    stamps[20] = stamps[21]
    stamps[30] = np.nan
    notes: list[str] = []
    t, rows = ordered("gnss", stamps, notes)
    assert (np.diff(t) > 0).all()
    assert rows[10] == 11
    assert len(t) == len(T) - 2
    assert [note.split()[1] for note in notes] == ["1", "1", "1"]
    assert all(note.startswith("gnss: ") for note in notes)


def test_after_a_restart_the_longer_part_is_kept() -> None:
    notes: list[str] = []
    t, rows = ordered("imu", np.concatenate([T[:100], T]), notes)
    assert np.array_equal(t, T)
    assert rows[0] == 100
    assert any("100 rows are left out" in note for note in notes)


LONG = np.arange(1, 24_001) / 200  # two minutes, through where a counter of 16 bits of milliseconds begins anew


@pytest.mark.parametrize("rows", [[13_090], [0], [23_999], [*range(999, 23_000, 1000)], [*range(13_080, 13_086)]])
@pytest.mark.parametrize("value", [0.0, 1e6, 1.7e9])
def test_a_few_stray_stamps_cost_their_own_rows_alone(rows: list[int], value: float) -> None:
    stamps = LONG.copy()
    stamps[rows] = value
    notes: list[str] = []
    t, kept = ordered("imu", stamps, notes)
    others = np.delete(np.arange(len(LONG)), rows)
    if value == 0.0 and rows == [0]:
        others = np.arange(len(LONG))  # a row at zero is as good as any
    assert np.array_equal(kept, others)
    assert np.array_equal(t, stamps[others])
    assert len(notes) == (len(others) < len(LONG))
    assert not any(isinstance(note, Loss) for note in notes)


@pytest.mark.parametrize(
    "strays",
    [
        {900: 1e9, 901: 0.0},
        {900: 0.0, 901: 1e9},
        {900: 1e9, 901: 0.0, 902: 1e6, 903: 5.0},
        dict.fromkeys(range(30, 24_000, 160), 0.0),
        {row: 1e9 if row % 20 else 0.0 for row in range(30, 24_000, 110)},
    ],
)
@pytest.mark.parametrize("wrap", [0.0, 65.536])
def test_stray_stamps_side_by_side_or_often_cost_their_own_rows_alone(strays: dict[int, float], wrap: float) -> None:
    """Of a counter that begins anew soon after the first of them, too."""
    whole = LONG + 61.0 if wrap else LONG
    stamps = whole % wrap if wrap else whole.copy()
    stamps[list(strays)] = list(strays.values())
    notes: list[str] = []
    t, kept = ordered("imu", stamps, notes)
    others = np.delete(np.arange(len(LONG)), list(strays))
    np.testing.assert_array_equal(kept, others)
    np.testing.assert_allclose(t, whole[others], rtol=0, atol=1e-6)
    assert f"imu: {len(strays)} times are far off those before and after, and left out" in notes


@pytest.mark.parametrize("off", [65.536, 4294.967296, 86_400.0, 604_800.0, -65.536, -86_400.0])
def test_a_stray_that_is_off_by_a_turn_of_a_counter_is_a_stray(off: float) -> None:
    """The step back from it was taken for the counter's, and half of the log with it."""
    stamps = 1e6 + LONG
    stamps[9000] += off
    t, kept = ordered("imu", stamps, [])
    np.testing.assert_array_equal(kept, np.delete(np.arange(len(LONG)), 9000))
    np.testing.assert_array_equal(t, np.delete(stamps, 9000))


@pytest.mark.parametrize("end", [0.0, 3.0])
def test_a_last_stamp_near_zero_begins_no_new_week(end: float) -> None:
    stamps = np.append(604_000.0 + LONG, end)
    t, kept = ordered("imu", stamps, [])
    np.testing.assert_array_equal(kept, np.arange(len(LONG)))
    np.testing.assert_array_equal(t, stamps[:-1])


@pytest.mark.parametrize("off", [500.0, -500.0])
@pytest.mark.parametrize("rows", [300, 1200, 20_000])
def test_as_many_strays_side_by_side_as_may_be_cost_no_others(rows: int, off: float) -> None:
    stamps, count, first = 1000.0 + LONG[:rows].copy(), max(8, rows // 100), rows // 3
    stamps[first : first + count] += off
    _, kept = ordered("imu", stamps, [])
    np.testing.assert_array_equal(kept, np.delete(np.arange(rows), np.arange(first, first + count)))


def test_rows_that_are_swapped_by_more_than_a_gap_cost_two_rows_each() -> None:
    order = np.arange(len(LONG))
    for row in range(300, 24_000, 400):
        order[[row, row + 25]] = order[[row + 25, row]]
    t, rows = ordered("imu", LONG[order], [])
    assert len(t) == len(LONG) - 2 * 60
    np.testing.assert_array_equal(LONG[order][rows], t)


def test_a_clock_that_is_set_back_again_and_again_leaves_its_longest_part() -> None:
    """Told as that, however short the parts are."""
    notes: list[str] = []
    stamps = np.concatenate([np.tile(LONG[:100], 120), LONG[:200], np.tile(LONG[:100], 118)])
    _, rows = ordered("imu", stamps, notes)
    np.testing.assert_array_equal(rows, np.arange(12_000, 12_200))
    assert any("time goes back" in note for note in notes)


@pytest.mark.parametrize("late", [9, 15, 100])
def test_a_row_that_comes_late_does_not_cut_the_stream(late: int) -> None:
    """By less than a gap it is put where it belongs, by more it is left out."""
    order = np.insert(np.delete(np.arange(len(LONG)), 5000), 5000 + late, 5000)
    notes: list[str] = []
    t, rows = ordered("imu", LONG[order], notes)
    assert len(t) == len(LONG) - (late > 20)
    assert np.array_equal(LONG[order][rows], t)
    assert len(notes) == 1


def test_rows_that_are_shuffled_are_put_in_order() -> None:
    """As several threads write them, here and there by more than a tenth of a second."""
    rng = np.random.default_rng(0)
    stamps, order = np.arange(35_000) / 50, np.arange(35_000)
    for first in rng.integers(0, len(order) - 6, len(order) // 50):
        order[first : first + 5] = rng.permutation(order[first : first + 5])
    notes: list[str] = []
    t, rows = ordered("imu", stamps[order], notes)
    assert np.array_equal(t, stamps)
    assert np.array_equal(order[rows], np.arange(len(order)))
    assert len(notes) == 1


def test_many_rows_in_disorder_take_no_minutes() -> None:
    """The usual step of all rows was found again for each: 35 s, and minutes of 200 000 rows."""
    rows = np.arange(60_000)
    stamps = 0.01 * rows[np.argsort(rows + np.random.default_rng(1).uniform(0, 60, len(rows)))]
    begins = time.process_time()
    ordered("imu", stamps, [])
    assert time.process_time() - begins < 5.0


@pytest.mark.parametrize(("rate_hz", "back_s"), [(1.0, 10.0), (1.0, 12.0), (0.5, 20.0), (10.0, 1.0)])
def test_a_slow_clock_that_is_set_back_is_not_shuffled(rate_hz: float, back_s: float) -> None:
    stamps = np.arange(400) / rate_hz
    notes: list[str] = []
    _, rows = ordered("gnss", stamps - np.where(np.arange(400) >= 250, back_s, 0.0), notes)
    assert np.array_equal(rows, np.arange(250))
    assert isinstance(notes[0], Loss)


@pytest.mark.parametrize("begins", [-3.0, 3.0])
def test_a_clock_that_is_set_back_is_not_one_that_began_anew(begins: float) -> None:
    """By nearly the size of a counter, or with a return to where it was."""
    notes: list[str] = []
    t, _ = ordered("imu", np.where(LONG > 66.0, LONG - 65.536 + begins, LONG), notes)
    assert t[-1] < 70
    assert isinstance(notes[0], Loss)
    assert "goes back 1 times" in notes[0]
    back = LONG.copy()
    back[13_100:13_500] -= 65.5
    notes = []
    t, _ = ordered("imu", back, notes)
    assert t[-1] <= LONG[-1]
    assert not any("began anew" in note for note in notes)


def test_a_clock_that_is_set_leaves_the_longer_part() -> None:
    notes: list[str] = []
    stamps = np.concatenate([LONG[:500], 1.7e9 + LONG[500:]])
    _, rows = ordered("gnss", stamps, notes)
    assert np.array_equal(rows, np.arange(500, len(LONG)))
    assert notes == ["gnss: 500 times are 3600 s and more from all others, a clock that was set: left out"]
    assert isinstance(notes[0], Loss)


@pytest.mark.parametrize(("before", "gap"), [(4000.0, 3000.0), (8000.0, 7000.0)])
def test_a_gap_may_be_as_long_as_all_else(before: float, gap: float) -> None:
    stamps = np.concatenate([np.arange(before), before + gap + np.arange(10.0)])
    assert len(ordered("gnss", stamps, [])[0]) == len(stamps)
    assert len(ordered("gnss", stamps + np.where(stamps > before, before, 0.0), [])[0]) == before


def test_gaps_are_told() -> None:
    notes: list[str] = []
    ordered("imu", np.delete(T, np.s_[100:150]), notes)
    assert notes == ["imu: a gap of 1.02 s, 1.98 s after its beginning"] or "a gap of 1.02 s" in notes[0]


@pytest.mark.parametrize("seed", range(5))
def test_no_increment_is_longer_than_the_first_and_nothing_is_lost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    imu = steady(np.sort(T + rng.uniform(-0.008, 0.008, len(T))))
    ready = bridged(imu)
    assert ready.dt.max() <= ready.dt[0] + 1e-15
    assert np.allclose(ready.t[1:] - ready.dt[1:], ready.t[:-1], rtol=0, atol=1e-12)
    assert np.allclose(ready.dtheta[1:].sum(axis=0), imu.dtheta[1:].sum(axis=0), rtol=1e-12)
    assert set(imu.t.tolist()) <= set(ready.t.tolist())


@pytest.mark.parametrize("before", [0.004, 0.03, 2.0])
def test_before_the_first_increment_nothing_is_known(before: float) -> None:
    imu = steady(T)
    whole = begun(imu, -before)
    first = len(whole) - len(imu)
    assert np.isnan(whole.dtheta[:first]).all()
    assert np.isnan(whole.dv[:first]).all()
    assert np.array_equal(whole.dtheta[first:], imu.dtheta)
    assert np.allclose(np.concatenate([[-before], whole.t[:-1]]), whole.t - whole.dt, rtol=0, atol=1e-9)
    assert whole.dt.max() <= 0.02 + 1e-9
    assert begun(imu, 0.0) is imu


@pytest.mark.parametrize("start", [0.0, 3.0, 5.985])
def test_over_a_gap_before_the_first_increment_nothing_is_known(start: float) -> None:
    """A single row before it, or a start in it: the first step is longer than all others, and no motion."""
    later = steady(T[T > 6.0])
    long = np.insert(later.dt[1:], 0, later.t[0])  # since a row at zero, which is no part of what is flown
    whole = begun(ImuSamples(later.t, long, np.full((len(long), 3), 0.1) * long[:, None], later.dv), start)
    ready = bridged(whole)
    assert ready.t[0] - ready.dt[0] >= start - 0.03  # the first is as long as any
    assert ready.dt.max() <= 0.035 + 1e-9
    lost = np.isnan(ready.dtheta).all(axis=1)
    assert ready.dt[lost].sum() == pytest.approx(later.t[0] - start - 0.02 if start < 5 else 0.0, abs=0.02)
    assert np.allclose(ready.dtheta[~lost] / ready.dt[~lost, None], 0.1)


def test_over_a_gap_nothing_is_known() -> None:
    ready = bridged(steady(np.delete(T, np.s_[100:150])))
    lost = np.isnan(ready.dtheta).all(axis=1)
    assert 0.95 < ready.dt[lost].sum() < 1.02
    assert np.isfinite(ready.dtheta[~lost]).all()


def test_rates_become_increments() -> None:
    rates = np.sin(T)[:, None] * np.ones(3)
    mean, point = (integrated(T, rates, rates, form).dtheta.sum(axis=0) for form in ("averaged", "instantaneous"))
    exact = np.cos(T[0]) - np.cos(T[-1])
    assert abs(point[0] - rates[0, 0] / 50 - exact) < 1e-4
    assert abs(mean[0] - rates[0, 0] / 50 - exact) > 1e-3
    given = integrated(T, rates, rates, "increments")
    assert given.dtheta is rates


def test_a_spare_unit_is_given_at_the_times_of_the_first() -> None:
    first, spare = steady(T), steady(T[:-20] + 0.007)
    ready = at_times(spare, first)
    assert np.array_equal(ready.t, first.t)
    known = np.isfinite(ready.dtheta).all(axis=1)
    assert np.allclose(ready.dtheta[known], first.dtheta[known])
    assert known[5:-25].all()
    assert not known[-10:].any()


@pytest.mark.parametrize("wrong", [0, 3])
def test_a_table_that_begins_with_its_newest_row_is_read_from_its_end(wrong: int) -> None:
    notes: list[str] = []
    t = T[::-1].copy()
    t[100 : 100 + wrong] = np.nan
    kept, rows = ordered("imu", t, notes)
    expected = np.flatnonzero(np.isfinite(t))[::-1]
    np.testing.assert_array_equal(rows, expected)
    np.testing.assert_array_equal(kept, t[expected])
    assert "imu: its times go back from row to row, and are taken from the last row on" in notes
