"""A mission and parameters for the autopilot that is to fly a scenario: read back by other people's readers."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from pymavlink import mavparm, mavwp
from pymavlink.dialects.v20 import common as mav

from nav.earth import SEA_LEVEL_DENSITY, isa_density
from testbed import Scenario, run
from testbed.bridges import files
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion import aircraft

GRAVITY, TURN_BANK_DEG = 9.81, 25.0
LOITER = Path("loiter_gnss_outage")
Place = tuple[float, float, float]
PLAN = """
[[plan]]
leg = "straight"
length_m = 1000
airspeed_mps = 30
[[plan]]
leg = "loiter"
radius_m = 300
turns = 2
centre = { lat_deg = 34.05, lon_deg = 108.05 }
[[plan]]
leg = "airspeed"
to_mps = 26

"""


def ahead(at: Place, course_deg: float, length: float, h: float) -> tuple[Place, float]:
    """Straight on in the plane that touches the Earth here: where it ends, and the course there."""
    way = length * np.cos(np.radians(course_deg)), length * np.sin(np.radians(course_deg))
    lat, lon, _ = pymap3d.ned2geodetic(*way, 0.0, at[0], at[1], h)
    converged = (lon - at[1]) * np.sin(np.radians(0.5 * (lat + at[0])))
    return (float(lat), float(lon), h), course_deg + float(converged)


def loiter_by_hand() -> list[Place]:
    """Where the legs of loiter_gnss_outage lead: 1500 m, up to 280 m at 2 m/s, a turn to 120 deg, 2500 m, circles."""
    first, course = ahead((34.0, 108.0, 150.0), 30.0, 1500.0, 150.0)
    above, course = ahead(first, course, 130.0 / 2.0 * 25.0, 280.0)
    radius = 25.0**2 / (GRAVITY * np.tan(np.radians(TURN_BANK_DEG)))
    before, after = np.radians([course, 120.0])  # the middle is to the right, and behind it the turn ends to its left
    north, east = radius * (np.sin(after) - np.sin(before)), radius * (np.cos(before) - np.cos(after))
    turned, bent = ahead(above, float(np.degrees(np.arctan2(east, north))), float(np.hypot(north, east)), 280.0)
    converged = bent - float(np.degrees(np.arctan2(east, north)))
    on, course = ahead(turned, 120.0 + converged, 2500.0, 280.0)
    middle, _ = ahead(on, course - 90.0, 400.0, 280.0)
    return [first, above, turned, on, middle]


def metres(a: Place, b: Place) -> float:
    return float(np.linalg.norm(pymap3d.geodetic2ned(*a, *b)))


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = files.write(LOITER, "plan", tmp_path_factory.mktemp("plan") / "loiter.plan")
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def test_the_plan_leads_where_the_legs_lead(plan: dict[str, Any]) -> None:
    items = plan["mission"]["items"]
    commands = [item["command"] for item in items]
    assert commands == [mav.MAV_CMD_NAV_WAYPOINT] * 4 + [mav.MAV_CMD_NAV_LOITER_TIME, mav.MAV_CMD_NAV_LOITER_UNLIM]
    places = [tuple(item["params"][4:]) for item in items]
    for place, expected in zip(places, [*loiter_by_hand(), loiter_by_hand()[-1]], strict=True):
        assert metres(place, expected) < 0.01
    assert items[4]["params"][:4] == [2000, 0, -400, 0]  # to the left
    assert metres(tuple(plan["mission"]["plannedHomePosition"]), (34.0, 108.0, 150.0)) < 1e-3


def test_the_plan_has_what_qgroundcontrol_asks_for(plan: dict[str, Any]) -> None:
    assert (plan["fileType"], plan["version"], plan["mission"]["version"]) == ("Plan", 1, 2)
    assert plan["geoFence"] == {"version": 2, "circles": [], "polygons": []}
    assert plan["rallyPoints"] == {"version": 2, "points": []}
    for number, item in enumerate(plan["mission"]["items"], 1):
        assert (item["type"], item["doJumpId"], item["autoContinue"]) == ("SimpleItem", number, True)
        assert (item["frame"], item["AltitudeMode"], item["Altitude"]) == (0, 2, item["params"][6])


def test_text_says_the_same(plan: dict[str, Any], tmp_path: Path) -> None:
    reader = mavwp.MAVWPLoader()
    items = plan["mission"]["items"]
    assert reader.load(str(files.write(LOITER, "wpl", tmp_path / "mission.waypoints"))) == 1 + len(items)
    assert metres((reader.wp(0).x, reader.wp(0).y, reader.wp(0).z), (34.0, 108.0, 150.0)) < 1e-3
    for number, item in enumerate(items, 1):
        own = reader.wp(number)
        assert (own.seq, own.command, own.frame, own.autocontinue) == (number, item["command"], item["frame"], 1)
        numbers = [own.param1, own.param2, own.param3, own.param4, own.x, own.y, own.z]
        assert numbers == pytest.approx(item["params"], abs=1e-8)


def test_airspeeds_are_changed_and_turns_are_timed(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    head, _, rest = (data_dir("scenarios") / "loiter_gnss_outage.toml").read_text("utf-8").partition("[[plan]]")
    path.write_text(head + PLAN + rest[rest.index("[sensors.imu]") :])
    items = json.loads(files.write(path, "plan", tmp_path / "own.plan").read_text())["mission"]["items"]
    speeds = [(item["frame"], *item["params"]) for item in items if item["command"] == mav.MAV_CMD_DO_CHANGE_SPEED]
    dense = np.sqrt(float(isa_density(150.0)) / SEA_LEVEL_DENSITY)
    assert [one[2] for one in speeds] == pytest.approx([30 * dense, 26 * dense], abs=0.006)
    assert {(one[0], one[1], one[3]) for one in speeds} == {(2, 0, -1)}
    (circles,) = (item["params"] for item in items if item["command"] == mav.MAV_CMD_NAV_LOITER_TIME)
    assert circles[0] == pytest.approx(2 * 2 * np.pi * 300 / 30, abs=0.06)
    assert metres(tuple(circles[4:]), (34.05, 108.05, 150.0)) < 0.01


def test_from_the_ground_it_begins_with_a_take_off(tmp_path: Path) -> None:
    path = files.write(Path("take_off"), "plan", tmp_path / "from_rest.plan")
    first = json.loads(path.read_text())["mission"]["items"][0]
    launch = aircraft.load("loiter").launch
    assert launch is not None
    assert first["command"] == mav.MAV_CMD_NAV_TAKEOFF
    assert first["params"][0] == launch.pitch_deg
    # 30 m at the climb that is kept at 25 m/s and 330 m: 4 m/s
    there, _ = ahead((47.0, 8.0, 300.0), 300.0, 30.0 / 4.0 * 25.4, 330.0)
    assert metres(tuple(first["params"][4:]), there) < 5
    trimmed = files.write(Path("take_off"), "px4-params", tmp_path / "from_rest.params").read_text()
    assert "FW_AIRSPD_TRIM\t25.0\t" in trimmed
    assert "FW_LAUN_DETCN_ON\t0\t6" in trimmed
    radius = 25.4**2 / (GRAVITY * np.tan(np.radians(TURN_BANK_DEG)))  # it circles at the end, though no leg does
    (circled,) = (float(line.split("\t")[3]) for line in trimmed.splitlines() if "NAV_LOITER_RAD" in line)
    assert circled == pytest.approx(radius, rel=0.02)
    own = mavparm.MAVParmDict()
    assert own.load(str(files.write(Path("take_off"), "ardupilot-params", tmp_path / "from_rest.parm")))
    assert (own["TKOFF_THR_MINACC"], own["TKOFF_THR_MINSPD"], own["AIRSPEED_CRUISE"]) == (0, 0, 25)


def test_parameters_for_ardupilot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = files.write(LOITER, "ardupilot-params", tmp_path / "plane.parm")
    own = mavparm.MAVParmDict()
    assert own.load(str(path))
    assert "Invalid line" not in capsys.readouterr().out
    outputs = {1: 4, 2: 19, 3: 70, 4: 21}  # aileron, elevator, throttle, rudder
    assert {n: own[f"SERVO{n}_FUNCTION"] for n in outputs} == outputs
    envelope = aircraft.load("loiter").airspeed
    slowest = envelope.margin * envelope.stall_mps
    assert slowest <= own["AIRSPEED_MIN"] <= own["AIRSPEED_CRUISE"] <= own["AIRSPEED_MAX"] <= envelope.max_mps
    assert own["AIRSPEED_CRUISE"] == pytest.approx(
        25 * np.sqrt(float(isa_density(150.0)) / SEA_LEVEL_DENSITY), abs=0.01
    )
    assert (own["GPS1_TYPE"], own["GPS1_DELAY_MS"], own["WP_LOITER_RAD"]) == (14, 100, -400)
    assert (own["ROLL_LIMIT_DEG"], own["ARSPD_TYPE"], own["ARSPD_USE"]) == (40, 100, 1)
    assert own["ARSPD_SKIP_CAL"] == 1
    assert (own["PTCH_RATE_P"], own["PTCH_RATE_FF"], own["RLL_RATE_P"], own["RLL_RATE_FF"]) == (0.15, 0.6, 0.3, 0.24)
    assert "GPS2_TYPE" not in own
    lines = path.read_text().splitlines()
    assert all(above.startswith("# ") for above, line in pairwise(lines) if not line.startswith("#"))
    assert any("before 4.5: LIM_ROLL_CD,4000" in line for line in lines)


def test_parameters_for_px4(tmp_path: Path) -> None:
    path = files.write(LOITER, "px4-params", tmp_path / "plane.params")
    rows = [line.split("\t") for line in path.read_text().splitlines() if not line.startswith("#")]
    assert all(row[:2] == ["1", "1"] and len(row) == 5 for row in rows)
    assert all(row[4] == ("9" if "." in row[3] else "6") for row in rows)
    own = {row[2]: float(row[3]) for row in rows}
    assert len(own) == len(rows)
    assert [own[f"PWM_MAIN_FUNC{n}"] for n in (1, 2, 3, 4)] == [201, 202, 101, 203]
    assert [own[f"CA_SV_CS{n}_TYPE"] for n in (0, 1, 2)] == [15, 3, 4]
    envelope = aircraft.load("loiter").airspeed
    assert own["FW_AIRSPD_STALL"] == envelope.stall_mps
    assert own["FW_AIRSPD_MIN"] == pytest.approx(envelope.margin * envelope.stall_mps, abs=0.006)
    assert own["FW_AIRSPD_MIN"] < own["FW_AIRSPD_TRIM"] < own["FW_AIRSPD_MAX"] == envelope.max_mps
    assert (own["EKF2_GPS_DELAY"], own["NAV_LOITER_RAD"], own["FW_R_LIM"]) == (100, 400, 40)
    assert (own["FW_THR_MIN"], own["FW_THR_MAX"]) == (0, 1)  # PX4's own aeroplanes have 0.05 and 0.6
    assert (own["COM_POS_LOW_EPH"], own["COM_POS_FS_EPH"]) == (-1, -1)  # they go home, then down, within an outage


def test_of_a_record_they_are_those_of_its_scenario(tmp_path: Path) -> None:
    run(Scenario.load("kinematic_u_flight", {"duration_s": 0.5}), out=tmp_path)
    for name in files.FILES:
        with pytest.raises(UserError, match=r"run\.nc: there is no (plan|aircraft) that an autopilot could fly"):
            files.write(tmp_path / "run.nc", name)
    assert not list(tmp_path.glob("run.p*")) + list(tmp_path.glob("run.w*"))
