"""Units and axes of a log that can't be right, by what its sensors say of each other."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from rich.console import Console

from nav.earth import SEA_LEVEL_DENSITY, isa_density, isa_pressure
from nav.samples import AirspeedSample, BarometerSample, FixType, GnssSample, ImuSamples
from testbed import Scenario
from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.feeds.mistaken import mistaken
from testbed.feeds.recorded import Recorded
from testbed.feeds.survey import phases, survey
from testbed.report.log import tables

RADIUS, SPEED, CLIMB, STANDS, LASTS = 200.0, 20.0, 2.0, 20.0, 200.0
RIGHT = "are units, columns and axes right?"


def flown():
    """Twenty seconds at rest, then a climbing circle to the right; the body level, its nose along the way."""
    rng = np.random.default_rng(7)
    t = np.arange(0.01, LASTS, 0.01)
    aloft = (t > STANDS)[:, None]
    rate = np.where(aloft, [0.0, 0.0, SPEED / RADIUS], 0.0) + rng.normal(0.0, 2e-3, (len(t), 3))
    force = np.where(aloft, [0.0, SPEED**2 / RADIUS, -9.8], [0.0, 0.0, -9.8]) + rng.normal(0.0, 0.05, (len(t), 3))
    imu = ImuSamples(t, np.full(len(t), 0.01), 0.01 * rate, 0.01 * force)
    fixes = []
    for now in np.arange(0.2, LASTS - 0.2, 0.2).tolist():
        flying = max(now - STANDS, 0.0)
        angle, moves = SPEED * flying / RADIUS, float(flying > 0)
        east, north, up = RADIUS * (1 - math.cos(angle)), RADIUS * math.sin(angle), CLIMB * flying
        lat, lon, h = pymap3d.enu2geodetic(*(rng.normal([east, north, up], 1.0)), 47.0, 8.0, 400.0)
        v_n = moves * np.array([SPEED * math.cos(angle), SPEED * math.sin(angle), -CLIMB]) + rng.normal(0.0, 0.1, 3)
        sigma = np.ones(3)
        fixes.append(
            GnssSample(
                now, now, math.radians(lat), math.radians(lon), h, v_n, sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.5
            )
        )
    return imu, fixes


IMU, FIXES = flown()


def log(imu=IMU, fixes=FIXES):
    return Log(Path("a.npz"), "table", {"imu": imu}, {"gnss": fixes}, None, 0.0, {})


def with_velocities(change):
    return [replace(one, v_n=change(one.v_n)) for one in FIXES]


def test_nothing_is_said_of_what_is_right():
    assert mistaken(log()) == []


WIND = np.array([3.0, -4.0, 0.0])


def beside(air=1.0, height=1.0, measured=1.0):
    """The log with an airspeed told times ``air`` and a barometer's height times ``measured``, GNSS's ``height``."""
    thin = math.sqrt(SEA_LEVEL_DENSITY / float(isa_density(600.0)))  # of the flight's middle, near enough
    speeds = [AirspeedSample(one.t, one.t, air * float(np.linalg.norm(one.v_n - WIND)) / thin) for one in FIXES]
    pressures = [BarometerSample(one.t, one.t, float(isa_pressure(measured * one.h))) for one in FIXES]
    fixes = [replace(one, h=height * one.h, v_n=one.v_n * [1, 1, height]) for one in FIXES]
    return replace(log(fixes=fixes), samples={"gnss": fixes, "barometer": pressures, "airspeed": speeds})


@pytest.mark.ci
@pytest.mark.parametrize(
    ("told", "said"),
    [
        (1.0, ""),
        (0.7, ""),
        (1.5, ""),
        (3.6, "km/h told as m/s"),
        (1 / 3.6, "m/s told as km/h"),
        (1.944, "kn told as m/s"),
        (2.237, "mph told as m/s"),
        (3.281, "ft/s told as m/s"),
        (7.0, ""),
    ],
)
def test_an_airspeed_in_another_unit_is_told_by_name(told, said):
    """A filter was too sure of it at the end, and nobody knew why."""
    found = mistaken(beside(air=told))
    assert len(found) == (told in (3.6, 1 / 3.6, 1.944, 2.237, 3.281, 7.0))
    as_made = f", as {said} is" if said else ""
    for one in found:
        times, _, rest = one.removeprefix("airspeed: by gnss true airspeed is ").partition(" ")
        assert float(times) == pytest.approx(1 / told, rel=0.03)
        assert rest == f"times what it says{as_made}: is its unit right?"
    scale = survey(beside(air=told)).airspeed_scale["airspeed"]
    assert scale == pytest.approx(1 / told, rel=0.03)


@pytest.mark.parametrize(
    ("height", "measured", "said"),
    [
        (1.0, 1.0, ""),
        (1.3, 1.0, ""),
        (1 / 0.3048, 1.0, "3.28|ft told as m"),
        (0.3048, 1.0, "0.305|m told as ft"),
        (1.0, 0.3048, "3.28|ft told as m"),
        (2.0, 1.0, "2|"),
    ],
)
def test_heights_in_another_unit_than_the_barometers_are_told_by_name(height, measured, said):
    times, _, pair = said.partition("|")
    as_made = f", as {pair} do" if pair else ""
    how = f"its heights go {times} times as far up and down as those of barometer{as_made}"
    assert mistaken(beside(height=height, measured=measured)) == (
        [f"gnss: {how}: are the units of both right?"] if said else []
    )


def test_a_barometer_of_another_flight_tells_no_unit():
    """It goes up and down by tens of metres, and otherwise than the receiver does."""
    other = [
        BarometerSample(one.t, one.t, float(isa_pressure(400 + 40 * math.sin(one.t / 7)))) for one in FIXES
    ]  # fmt: skip
    assert mistaken(replace(log(), samples={"gnss": FIXES, "barometer": other})) == []


def test_six_climbs_show_velocities_down_that_are_reversed():
    first = int((STANDS + 4) * 5)
    (said,) = mistaken(log(fixes=with_velocities(lambda v: v * [1, 1, -1])[: first + 8 * 25]))
    assert said.startswith("gnss: its positions climb otherwise than its velocities say (10")


def test_a_short_log_says_nothing():
    few = ImuSamples(*(column[:400] for column in (IMU.t, IMU.dt, IMU.dtheta, IMU.dv)))
    assert mistaken(log(few, with_velocities(lambda v: 9 * v)[:15])) == []
    assert mistaken(log(fixes=[replace(one, v_n=np.full(3, np.nan)) for one in FIXES])) == []


@pytest.mark.parametrize(
    "change", [lambda v: v / 3.6, lambda v: 3.6 * v, lambda v: v[[1, 0, 2]], lambda v: v * [1, -1, 1]]
)
def test_velocities_that_do_not_lead_where_positions_are(change):
    (said,) = [one for one in mistaken(log(fixes=with_velocities(change))) if "positions go" in one]
    assert said.startswith("gnss: its positions go otherwise than its velocities say (")
    assert said.endswith(RIGHT)


def test_heights_that_velocities_contradict():
    (said,) = mistaken(log(fixes=with_velocities(lambda v: v * [1, 1, -1])))
    assert said.startswith("gnss: its positions climb otherwise than its velocities say (10")
    assert said.endswith(RIGHT)


@pytest.mark.parametrize("wrong", [math.pi / 180, 180 / math.pi])
def test_gyros_in_another_unit(wrong):
    (said,) = mistaken(log(replace(IMU, dtheta=wrong * IMU.dtheta)))
    assert said.startswith("imu: its gyros feel ")
    assert said.endswith("is their unit right?")
    assert ("where the course of gnss turns by 5.7" in said) == (wrong < 1)


def test_one_row_that_is_wrong_is_no_wrong_unit():
    dtheta = IMU.dtheta.copy()
    dtheta[len(dtheta) // 2] = 1e5
    assert mistaken(log(replace(IMU, dtheta=dtheta))) == []


def test_few_turns_of_a_long_way_are_felt():
    """All that turned were the one step in a hundred that turned most."""
    t = np.arange(0.1, 2000, 0.1)
    rate = np.where(np.abs(t % 500 - 250) < 2.5, 0.4, 0.0)
    angle = np.concatenate([[0.0], np.cumsum(rate * 0.1)])[:-1]
    imu = ImuSamples(t, np.full(len(t), 0.1), 0.1 * rate[:, None] * [0, 0, 1.0], np.tile([0, 0, -0.98], (len(t), 1)))
    fixes = []
    north = east = 0.0
    for now, turned in zip(t[::10].tolist(), angle[::10].tolist(), strict=True):
        v_n = 25.0 * np.array([math.cos(turned), math.sin(turned), 0.0])
        north, east = north + v_n[0], east + v_n[1]
        lat, lon, h = pymap3d.enu2geodetic(east, north, 0.0, 47.0, 8.0, 400.0)
        fixes.append(
            replace(FIXES[0], t=now, t_arrival=now, lat=math.radians(lat), lon=math.radians(lon), h=h, v_n=v_n)
        )
    assert not [one for one in mistaken(log(imu, fixes)) if "its gyros feel" in one]


@pytest.mark.parametrize("wrong", [9.8, 1 / 9.8, 0.5])
def test_accelerometers_in_another_unit(wrong):
    (said,) = mistaken(log(replace(IMU, dv=wrong * IMU.dv)))
    assert said.startswith("imu: it feels ")
    assert float(said.split()[3]) == pytest.approx(wrong * math.hypot(9.8, SPEED**2 / RADIUS), rel=0.02)
    assert said.endswith("is the unit of its accelerometers right?")


@pytest.mark.parametrize(
    ("turned", "said"),
    [
        ([1, -1, -1], ["imu: at rest it lies on its back: are its axes forward, right and down?"]),
        ([-1, -1, 1], []),
    ],
)
def test_a_unit_on_its_back(turned, said):
    assert mistaken(log(replace(IMU, dv=IMU.dv * turned))) == said


def test_what_stands_on_its_tail_is_sound():
    on_its_tail = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert mistaken(log(replace(IMU, dtheta=IMU.dtheta @ on_its_tail.T, dv=IMU.dv @ on_its_tail.T))) == []


def test_a_receiver_that_never_has_a_fix_is_told():
    assert mistaken(log(fixes=[replace(one, fix_type=FixType.NO_FIX) for one in FIXES])) == ["gnss: it never has a fix"]


@pytest.mark.parametrize(("rate", "step"), [(20.0, ""), (180.0, "9")])
def test_a_unit_that_turns_far_between_two_samples(rate, step):
    """At 20 Hz, to and fro, so that its course is as it was."""
    t = np.arange(0.05, LASTS, 0.05)
    rates = np.zeros((len(t), 3))
    rates[:, 2] = np.radians(rate) * np.where(t % 2 < 1, 1.0, -1.0)
    imu = ImuSamples(t, np.full(len(t), 0.05), 0.05 * rates, np.tile([0.0, 0.0, -0.49], (len(t), 1)))
    told = mistaken(log(imu, fixes=FIXES[:5]))
    assert [one.split(" from one")[0] for one in told] == ([f"imu: it turns by {step} deg"] if step else [])


def test_a_steady_flight_without_its_receiver_is_no_rest():
    """As it circles, rates and forces are as steady as at rest."""
    lost = [one if not 100 < one.t < 140 else replace(one, fix_type=FixType.NO_FIX) for one in FIXES]
    assert [phase.name for phase in phases(log(fixes=lost))] == ["rest", "flying"]
    taking_off = [one if not 15 < one.t < 30 else replace(one, fix_type=FixType.NO_FIX) for one in FIXES]
    assert [phase.name for phase in phases(log(fixes=taking_off))] == ["rest", "moving", "flying"]
    late = [one if one.t > 10 else replace(one, fix_type=FixType.NO_FIX) for one in FIXES]
    assert [phase.name for phase in phases(log(fixes=late))] == ["rest", "flying"]


def test_without_velocities_places_say_that_it_flies():
    """Circles that shake nothing were taken for rest, and their turns for a bias of the gyros."""
    silent = [replace(one, v_n=np.full(3, math.nan)) for one in FIXES]
    smooth = np.where(IMU.t > STANDS, SPEED / RADIUS, 0.0)[:, None] * [0.0, 0.0, 0.01]
    pushed = np.where((IMU.t > STANDS)[:, None], [0.0, SPEED**2 / RADIUS, -9.8], [0.0, 0.0, -9.8]) * 0.01
    found = phases(log(ImuSamples(IMU.t, IMU.dt, smooth, pushed), silent))
    assert [phase.name for phase in found][:: len(found) - 1] == ["rest", "flying"]
    assert found[0].end < STANDS + 6


def table(folder, lies=(1, 1, 1), says=1.0, sensors=""):
    """The scenario of a table with both, and a receiver that nobody uses unless ``sensors`` has it."""
    flat = {"imu_t": IMU.t, "gyro": IMU.dtheta / 0.01 * lies, "accel": IMU.dv / 0.01 * lies}
    flat |= {name: [getattr(one, name) for one in FIXES] for name in ("lat", "lon", "h", "t", "v_n")}
    np.savez(folder / "a.npz", **flat, v=says * np.array(flat["v_n"]))
    place = 'time = "t"\nlat = "lat"\nlon = "lon"\nheight = "h"\n'
    (folder / "a.toml").write_text(
        'title = "a"\nduration_s = 190\n[truth]\nsource = "log"\nfile = "a.npz"\n'
        '[truth.columns.imu]\ntime = "imu_t"\ngyro = "gyro"\naccel = "accel"\n'
        f'[truth.columns.gnss]\n{place}velocity = "v_n"\n[truth.columns.second]\nkind = "gnss"\n{place}velocity = "v"\n'
        f'[sensors.imu]\ngrade = "mems-hobby"\n{sensors}[sensors.gnss]\ngrade = "u-blox-m8"\n'
        "horizontal_white_m = 1.0\nvertical_white_m = 1.0\n"
        '[[estimator]]\nname = "ins"\nkind = "ins"\naids = ["gnss"]\n'
    )
    return Scenario.load(folder / "a.toml")


def shown(scenario):
    console = Console(width=400)
    with console.capture() as kept:
        console.print(next(tables(survey(formats.open_log(scenario.truth)))))
    return kept.get()


def test_a_log_says_it_of_all_and_a_run_of_what_it_uses(tmp_path):
    said = "second: its positions go otherwise than its velocities say"
    unused = table(tmp_path, says=3.6)
    assert said in shown(unused)
    assert Recorded(unused, 1).remark() == ""
    used = table(tmp_path, says=3.6, sensors='[sensors.second]\nkind = "gnss"\n')
    assert said in Recorded(used, 1).remark()


def test_a_unit_that_is_told_to_be_mounted_on_its_back_is_sound(tmp_path):
    on_its_back = table(tmp_path, lies=(1, -1, -1))
    assert "at rest it lies on its back" in shown(on_its_back)
    assert "at rest it lies on its back" in Recorded(on_its_back, 1).remark()
    assert Recorded(table(tmp_path, (1, -1, -1), sensors="mounting_deg = [180, 0, 0]\n"), 1).remark() == ""


def test_a_velocity_that_is_unknown_is_no_warning() -> None:
    """The console had numpy's, of a division of what is no number."""
    fixes = list(FIXES)
    fixes[300] = replace(fixes[300], v_n=np.full(3, np.nan))
    with np.errstate(all="raise"):
        assert mistaken(log(fixes=fixes)) == []
