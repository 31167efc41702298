"""Legs and the guidance law, on a point mass in wind; geometry against pymap3d."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymap3d
import pytest
from pydantic import TypeAdapter, ValidationError

from testbed.motion import aircraft
from testbed.motion.aircraft import GRAVITY
from testbed.motion.guidance import Guidance, plan_mistakes
from testbed.motion.legs import Leg
from testbed.motion.paths import Feedback, TangentPlane, turn_radius, wrap

ELLIPSOID = pymap3d.Ellipsoid.from_name("wgs84")
PLAN = TypeAdapter(list[Leg])
RATE_HZ = 20.0
LOITER = aircraft.load("loiter")


def legs(*tables: dict[str, Any]) -> list[Any]:
    return PLAN.validate_python(list(tables))


def feedback(
    lat: float, lon: float, h: float, v_n: Any, heading: float, airspeed: float, roll: float = 0.0
) -> Feedback:
    return Feedback(lat, lon, h, v_n[0], v_n[1], v_n[2], roll, 0.0, heading, 0.0, 0.0, 0.0, airspeed)


class PointMass:
    """Coordinated turns with first-order bank, altitude and airspeed exactly as commanded, on the WGS84 ellipsoid."""

    def __init__(
        self,
        plan: list[Any],
        lat: float = 34.0,
        lon: float = 108.0,
        course: float = 0.5,
        speed: float = 25.0,
        wind: Any = (0.0, 0.0),
    ) -> None:
        self.lat, self.lon, self.h = math.radians(lat), math.radians(lon), 800.0
        self.bank, self.speed, self.wind = 0.0, speed, wind
        self.heading = course
        self.guidance = Guidance(plan, LOITER, self.state(), 800.0, speed, 1 / RATE_HZ)

    def velocity(self) -> tuple[float, float]:
        return (
            self.speed * math.cos(self.heading) + self.wind[0],
            self.speed * math.sin(self.heading) + self.wind[1],
        )

    def state(self) -> Feedback:
        return feedback(self.lat, self.lon, self.h, (*self.velocity(), 0.0), wrap(self.heading), self.speed, self.bank)

    def fly(self, limit_s: float = 4000.0) -> np.ndarray:
        """Rows of lat, lon [deg], leg, course, heading [rad], bank, altitude, airspeed until the plan is flown."""
        rows = []
        for _ in range(round(limit_s * RATE_HZ)):
            command = self.guidance.step(self.state())
            if self.guidance.done:
                return np.array(rows)
            for _ in range(2):
                dt = 0.5 / RATE_HZ
                self.bank += dt * (command.bank - self.bank) / 0.4
                self.heading += dt * GRAVITY * math.tan(self.bank) / self.speed
                north, east = self.velocity()
                w = math.sqrt(1 - ELLIPSOID.eccentricity**2 * math.sin(self.lat) ** 2)
                meridian = ELLIPSOID.semimajor_axis * (1 - ELLIPSOID.eccentricity**2) / w**3 + self.h
                parallel = (ELLIPSOID.semimajor_axis / w + self.h) * math.cos(self.lat)
                self.lat += north * dt / meridian
                self.lon = wrap(self.lon + east * dt / parallel)
            self.h, self.speed = command.altitude, command.airspeed
            north, east = self.velocity()
            place = math.degrees(self.lat), math.degrees(self.lon)
            course = math.atan2(east, north)
            rows.append((*place, self.guidance.leg, course, self.heading, self.bank, self.h, self.speed))
        raise AssertionError(f"the plan did not end: {self.guidance.activity()}")


def distances(track: np.ndarray, lat: float, lon: float) -> np.ndarray:
    north, east, _ = pymap3d.geodetic2ned(track[:, 0], track[:, 1], 800.0, lat, lon, 800.0)
    return np.hypot(north, east)


PLACES = [(34.0, 108.0), (-51.0, 179.995), (84.0, -20.0), (0.0, 0.0), (-84.0, -179.999)]


@pytest.mark.ci
@pytest.mark.parametrize(("lat", "lon"), PLACES)
@pytest.mark.parametrize("wind", [(0.0, 0.0), (-6.0, 5.0)])
@pytest.mark.parametrize("direction", ["left", "right"])
def test_loiter_about_a_centre(lat: float, lon: float, wind: Any, direction: str) -> None:
    centre_lat, centre_lon, _ = pymap3d.ned2geodetic(1500.0, 300.0, 0.0, lat, lon, 0.0)
    plan = legs(
        {
            "leg": "loiter",
            "radius_m": 300,
            "turns": 2,
            "direction": direction,
            "centre": {"lat_deg": float(centre_lat), "lon_deg": float(centre_lon)},
        }
    )
    track = PointMass(plan, lat, lon, wind=wind).fly()
    radius = distances(track, float(centre_lat), float(centre_lon))
    on_circle = radius[len(radius) // 2 :]
    assert np.sqrt(np.mean((on_circle - 300.0) ** 2)) < 2.0
    turned = np.diff(np.unwrap(track[len(track) // 2 :, 3]))
    assert np.sign(np.mean(turned)) == (1 if direction == "right" else -1)


def test_loiter_here_counts_turns_and_touches_where_it_began() -> None:
    mass = PointMass(legs({"leg": "loiter", "radius_m": 250, "turns": 3, "direction": "right"}))
    start = math.degrees(mass.lat), math.degrees(mass.lon)
    track = mass.fly()
    # The circle lies to the right of the course at the start, one radius away.
    centre = pymap3d.ned2geodetic(-250 * math.sin(0.5), 250 * math.cos(0.5), 0.0, *start, 0.0)
    assert np.abs(distances(track, float(centre[0]), float(centre[1])) - 250).max() < 6.0
    assert len(track) / RATE_HZ == pytest.approx(3 * 2 * math.pi * 250 / 25, rel=0.02)


@pytest.mark.parametrize("course", np.radians([0.0, 89.0, 181.0, -91.0]))
def test_straight_length_and_course_in_crosswind(course: float) -> None:
    mass = PointMass(legs({"leg": "straight", "length_m": 3000}), course=course, wind=(3.0, -4.0))
    start = math.degrees(mass.lat), math.degrees(mass.lon)
    track_course = math.atan2(*mass.velocity()[::-1])  # a leg keeps the ground track it begins with
    track = mass.fly()
    north, east, _ = pymap3d.geodetic2ned(track[:, 0], track[:, 1], 800.0, *start, 800.0)
    cross = east * math.cos(track_course) - north * math.sin(track_course)
    assert np.abs(cross).max() < 0.5
    assert np.hypot(north[-1], east[-1]) == pytest.approx(3000, abs=2.0)


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_straight_to_a_place(lat: float, lon: float) -> None:
    to_lat, to_lon, _ = pymap3d.ned2geodetic(-2500.0, 4000.0, 0.0, lat, lon, 0.0)
    to_lon = (float(to_lon) + 180) % 360 - 180
    plan = legs({"leg": "straight", "to": {"lat_deg": float(to_lat), "lon_deg": to_lon}})
    track = PointMass(plan, lat, lon, course=2.0, wind=(5.0, 2.0)).fly()
    assert distances(track, float(to_lat), to_lon)[-1] < 3.0


@pytest.mark.parametrize(
    ("table", "turned_deg"),
    [
        ({"to_deg": 120}, 120 - math.degrees(0.5)),
        ({"to_deg": 330}, 330 - 360 - math.degrees(0.5)),
        ({"to_deg": 330, "direction": "right"}, 330 - math.degrees(0.5)),
        ({"to_deg": 60, "direction": "left"}, 60 - 360 - math.degrees(0.5)),
        ({"by_deg": 400}, 400),
        ({"by_deg": -90}, -90),
    ],
)
def test_turn(table: dict[str, Any], turned_deg: float) -> None:
    track = PointMass(legs({"leg": "turn", **table}), wind=(4.0, 0.0)).fly()
    assert math.degrees(track[-1, 4] - 0.5) == pytest.approx(turned_deg, abs=3.0)


def test_u_turn_comes_back_on_a_parallel() -> None:
    plan = legs({"leg": "u_turn", "radius_m": 200, "direction": "right"}, {"leg": "straight", "length_m": 1000})
    mass = PointMass(plan)
    start = math.degrees(mass.lat), math.degrees(mass.lon)
    track = mass.fly()
    assert wrap(track[-1, 3] - (0.5 + math.pi)) == pytest.approx(0.0, abs=0.01)
    north, east, _ = pymap3d.geodetic2ned(track[-1, 0], track[-1, 1], 800.0, *start, 800.0)
    assert east * math.cos(0.5) - north * math.sin(0.5) == pytest.approx(400, abs=4.0)


def test_u_turn_without_a_radius_keeps_its_bank_downwind() -> None:
    track = PointMass(legs({"leg": "u_turn"}), wind=(8.0, 0.0)).fly()
    assert math.radians(15) < np.abs(track[:, 5]).max() < math.radians(33)


def test_racetrack_laps_close() -> None:
    mass = PointMass(legs({"leg": "racetrack", "length_m": 800, "radius_m": 200, "laps": 2}), wind=(3.0, 3.0))
    start = math.degrees(mass.lat), math.degrees(mass.lon)
    track = mass.fly()
    assert distances(track, *start)[-1] < 5.0
    # Furthest from the start: the far end of the opposite straight's half circle.
    assert distances(track, *start).max() == pytest.approx(math.hypot(800 + 200, 200), rel=0.06)


def test_figure_eight_turns_both_ways_and_closes() -> None:
    mass = PointMass(legs({"leg": "figure_eight", "radius_m": 200, "turns": 1}))
    start = math.degrees(mass.lat), math.degrees(mass.lon)
    track = mass.fly()
    turn = np.unwrap(track[:, 3])
    assert turn.max() - turn.min() == pytest.approx(2 * math.pi, abs=0.3)
    assert abs(turn[-1] - turn[0]) < 0.3
    assert distances(track, *start)[-1] < 10.0


def test_s_turns_end_on_their_course() -> None:
    track = PointMass(legs({"leg": "s_turns", "radius_m": 250, "turns": 3, "swing_deg": 45})).fly()
    swings = np.degrees(np.unwrap(track[:, 3]) - 0.5)
    assert swings.min() == pytest.approx(-45, abs=4)
    assert swings.max() == pytest.approx(45, abs=4)
    assert swings[-1] == pytest.approx(0, abs=8)


def test_climb_descend_and_airspeed_ramp_to_their_ends() -> None:
    plan = legs(
        {"leg": "climb", "to_m": 860, "rate_mps": 2},
        {"leg": "airspeed", "to_mps": 28},
        {"leg": "descend", "to_m": 830, "rate_mps": 1.5},
    )
    track = PointMass(plan).fly()
    climb, airspeed, descent = (track[track[:, 2] == leg] for leg in range(3))
    assert len(climb) / RATE_HZ == pytest.approx(30, abs=3)
    assert climb[-1, 6] > 855
    assert airspeed[-1, 7] == 28
    assert len(descent) / RATE_HZ == pytest.approx(20, abs=4)
    assert np.diff(track[:, 6]).max() == pytest.approx(2 / RATE_HZ)
    assert np.diff(track[:, 6]).min() == pytest.approx(-1.5 / RATE_HZ)


def test_any_leg_may_change_altitude_and_airspeed_on_the_way() -> None:
    table = {"leg": "loiter", "radius_m": 300, "duration_s": 60, "alt_m": 850, "airspeed_mps": 27}
    track = PointMass(legs(table)).fly()
    assert len(track) / RATE_HZ == pytest.approx(60, abs=0.1)
    assert track[-1, 6:].tolist() == [850, 27]


def test_activity_says_leg_and_progress() -> None:
    mass = PointMass(legs({"leg": "loiter", "radius_m": 300, "turns": 4}))
    said = set()
    try:
        mass.fly(120)
    except AssertionError as error:
        said.add(str(error))
    assert said == {f"the plan did not end: loiter {120 * 25 / (2 * math.pi * 300):.1f}/4 turns"}


def test_bank_never_passes_the_limit_of_the_airspeed() -> None:
    plan = legs({"leg": "turn", "by_deg": 180}, {"leg": "loiter", "radius_m": 75, "turns": 2})
    track = PointMass(plan, speed=21.5).fly()
    assert np.abs(track[:, 5]).max() <= LOITER.bank_limit(21.5, 800.0) + 1e-9
    assert LOITER.bank_limit(40.0, 0.0) == LOITER.max_bank
    assert LOITER.bank_limit(LOITER.min_airspeed(0.0), 0.0) == 0.0


@pytest.mark.parametrize(("lat", "lon"), [*PLACES, (84.9, 10.0)])
def test_tangent_plane_against_pymap3d(lat: float, lon: float) -> None:
    plane = TangentPlane(math.radians(lat), math.radians(lon))
    for north, east, h in [(1000.0, -2000.0, 500.0), (-15000.0, 20000.0, 3000.0)]:
        # A point at height h whose horizontal offset, measured at that height, is north, east.
        down = 0.0
        for _ in range(5):
            at_lat, at_lon, at_h = pymap3d.ned2geodetic(north, east, down, lat, lon, h)
            down += at_h - h
        v_n = np.array([20.0, -7.0, 1.5])
        motion = plane.motion(feedback(math.radians(at_lat), math.radians(at_lon), h, v_n, 0.3, 25.0))
        assert (motion.north, motion.east) == pytest.approx((north, east), abs=1e-4)
        ahead = [pymap3d.enu2ecef(v_n[1] * t, v_n[0] * t, -v_n[2] * t, at_lat, at_lon, h) for t in (-1.0, 1.0)]
        seen = [pymap3d.ecef2ned(*point, lat, lon, h) for point in ahead]
        v_north, v_east = (np.array(seen[1]) - np.array(seen[0]))[:2] / 2
        assert (motion.v_north, motion.v_east) == pytest.approx((v_north, v_east), abs=1e-6)


# --- what is refused


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"leg": "straight"}, "ends by length_m or by to"),
        ({"leg": "straight", "length_m": 10, "to": {"lat_deg": 1, "lon_deg": 1}}, "give one of them"),
        ({"leg": "loiter", "radius_m": 300}, "ends by turns or by duration_s"),
        ({"leg": "turn"}, "ends by to_deg or by by_deg"),
        ({"leg": "turn", "by_deg": 90, "direction": "left"}, "leave direction out"),
        ({"leg": "climb", "to_m": 900, "rate_mps": -1}, "greater than 0"),
        ({"leg": "racetrack", "length_m": 500, "radius_m": 200}, "ends by laps or by duration_s"),
        ({"leg": "figure_eight", "radius_m": 200}, "ends by turns or by duration_s"),
        ({"leg": "loiter", "radius_m": 300, "turn": 2}, "Extra inputs"),
        ({"leg": "hover"}, "does not match any of the expected tags"),
    ],
)
def test_a_leg_that_says_nothing_flyable_is_refused(table: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        legs(table)


@pytest.mark.parametrize(
    ("tables", "start", "wind", "message"),
    [
        (
            [{"leg": "loiter", "radius_m": 80, "turns": 1}],
            {},
            0,
            r"plan\[0\]\.radius_m: 80 m is below the bank limit at 25",
        ),
        ([{"leg": "loiter", "radius_m": 130, "turns": 1}], {}, 8, r"plan\[0\]\.radius_m: .* and 8 m/s of wind"),
        (
            [{"leg": "straight", "length_m": 9}, {"leg": "climb", "to_m": 700}],
            {},
            0,
            r"plan\[1\]\.to_m: 700 m is not above the 800 m before it: use a descend leg",
        ),
        ([{"leg": "descend", "to_m": 900}], {}, 0, r"plan\[0\]\.to_m: .* use a climb leg"),
        ([{"leg": "climb", "to_m": 900, "rate_mps": 6}], {}, 0, r"plan\[0\]\.rate_mps: 6 m/s is too much of a climb"),
        (
            [{"leg": "descend", "to_m": 400, "rate_mps": 5}],
            {},
            0,
            r"plan\[0\]\.rate_mps: 5 m/s is too much of a descent",
        ),
        (
            [{"leg": "climb", "to_m": 3500, "airspeed_mps": 20}],
            {},
            0,
            r"plan\[0\]\.airspeed_mps: 20 m/s .* near the stall",
        ),
        (
            [{"leg": "straight", "length_m": 9, "airspeed_mps": 43}],
            {},
            0,
            r"plan\[0\]\.airspeed_mps: 43 m/s .* more than",
        ),
        (
            [{"leg": "straight", "length_m": 9}],
            {"airspeed_mps": 15.0},
            0,
            r"truth\.start\.airspeed_mps: .* near the stall",
        ),
        ([{"leg": "straight", "length_m": 9}], {"alt_m": 5.0}, 0, r"truth\.start\.alt_m: 5 m can't be flown"),
    ],
)
def test_a_plan_that_cannot_be_flown_is_refused(
    tables: list[Any], start: dict[str, float], wind: float, message: str
) -> None:
    beginning = SimpleNamespace(**{"alt_m": 800.0, "airspeed_mps": 25.0, **start})
    (key, what), *others = plan_mistakes(legs(*tables), beginning, LOITER, wind)
    assert re.match(message, f"{key}: {what}")
    assert not others


def test_every_leg_that_this_aircraft_can_never_fly_is_named() -> None:
    beginning = SimpleNamespace(alt_m=800.0, airspeed_mps=25.0)
    plan = legs(
        {"leg": "loiter", "radius_m": 20, "turns": 1},
        {"leg": "airspeed", "to_mps": 12},
        {"leg": "airspeed", "to_mps": 80},
        {"leg": "climb", "to_m": 9000},
        {"leg": "descend", "to_m": -20},
        {"leg": "straight", "length_m": 100, "alt_m": 0},
    )
    found = dict(plan_mistakes(plan, beginning, LOITER))
    said = {
        "plan[0].radius_m": "below the bank limit at any airspeed",
        "plan[1].to_mps": "too slow: the aircraft stalls at",
        "plan[2].to_mps": "too fast",
        "plan[3].to_m": "can't be flown",
        "plan[4].to_m": "the ground is at 0 m",
        "plan[5].alt_m": "the ground is at 0 m",
    }
    assert found.keys() == said.keys()
    for key, text in said.items():
        assert text in found[key]
    assert "plan[1].to_mps" not in dict(plan_mistakes(plan, beginning, aircraft.load("flying_wing")))  # it can: 12 m/s


def test_altitude_and_airspeed_carry_over_from_leg_to_leg() -> None:
    beginning = SimpleNamespace(alt_m=800.0, airspeed_mps=25.0)
    tight = {"leg": "loiter", "radius_m": 110, "turns": 1}
    assert not plan_mistakes(legs({"leg": "airspeed", "to_mps": 23}, tight), beginning, LOITER)
    ((key, _),) = plan_mistakes(legs({"leg": "airspeed", "to_mps": 30}, tight), beginning, LOITER)
    assert key == "plan[1].radius_m"


def test_the_least_radius_holds_the_bank_limit() -> None:
    assert turn_radius(25.0, math.radians(30)) == pytest.approx(25**2 / (9.81 * math.tan(math.pi / 6)))
