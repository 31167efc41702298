"""MAVSDK, what programs for PX4 are written with, hears and asks everything, and breaks the GNSS."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pymap3d
import pytest
from programs import ROOT, START_S, Program

from testbed import Scenario

pytestmark = pytest.mark.slow
STATION = Path(__file__).parent / "mavsdk_station.py"
PICTURE = ROOT / "runs" / "clients" / "mavsdk.png"

Session = dict[str, Any]


@pytest.fixture
def listen(clients: Path, fly: Callable[..., int], start: Callable[..., Program]) -> Callable[..., Session]:
    """Fly, and let a station fail the GNSS for so long and then heal it; what it was told."""

    def session(off_s: float, ok_s: float, *arguments: str, realtime: float = 1.0) -> Session:
        port = fly("u_turn", *arguments, realtime=realtime)
        station = start(clients / "python", STATION, f"udpin://127.0.0.1:{port}", str(off_s), str(ok_s))
        assert station.wait(START_S) == 0, station.output[-4000:]
        told: Session = json.loads(station.output.splitlines()[-1])
        return told

    return session


def test_everything_answers_and_a_failure_shows(listen: Callable[..., Session]) -> None:
    session = listen(4, 8)
    everything_answers(session)
    failure_shows_within_two_seconds_and_passes(session)


def everything_answers(session: Session) -> None:
    asked, heard = session["asked"], session["heard"]
    assert asked["system"]["answer"] == ["PX4", "FIXED_WING"]
    refused = {name: told for name, told in asked.items() if "error" in told and name != "battery"}
    assert not refused
    slow = {name: told["took"] for name, told in asked.items() if told.get("took", 0) > (5 if name == "params" else 2)}
    assert not slow
    assert "UNSUPPORTED" in asked["battery"]["error"]

    silent = [name for name, values in heard.items() if not values]
    assert not silent

    scenario = Scenario.load("u_turn")
    start = scenario.truth.start
    lat, lon = heard["position"][-1][1]["latitude_deg"], heard["position"][-1][1]["longitude_deg"]
    north = (lat - start.lat_deg) * 111.1e3
    east = (lon - start.lon_deg) * 111.3e3 * math.cos(math.radians(start.lat_deg))
    assert 100 < math.hypot(north, east) < 3000  # it has flown, and is still on its way
    true = heard["ground_truth"][-1][1]
    off = math.hypot(true["latitude_deg"] - lat, (true["longitude_deg"] - lon) * math.cos(math.radians(lat))) * 111.1e3
    assert off < 10
    assert heard["flight_mode"][-1][1] == "HOLD"
    assert heard["armed"][-1][1]
    assert heard["in_air"][-1][1]
    assert abs(heard["attitude_euler"][-1][1]["roll_deg"]) < 45
    assert 15 < heard["fixedwing_metrics"][-1][1]["airspeed_m_s"] < 35
    assert 280 < heard["position"][-1][1]["absolute_altitude_m"] < 320
    assert len(heard["odometry"][-1][1]["pose_covariance"]["covariance_matrix"]) == 21
    assert heard["odometry"][-1][1]["pose_covariance"]["covariance_matrix"][0] > 0

    params = asked["params"]["answer"]
    named = {one["name"]: one["value"] for kind in ("int_params", "float_params") for one in params[kind]}
    assert named["SYS_FAILURE_EN"] == 1
    assert named["SIM_GPS1_ENABLE"] == 1
    assert len(named) == sum(len(params[kind]) for kind in ("int_params", "float_params"))
    assert len(asked["mission_raw"]["answer"]) >= len(scenario.plan)
    progress = heard["mission_progress"][-1][1]
    assert 0 <= progress["current"] < progress["total"]


def failure_shows_within_two_seconds_and_passes(session: Session) -> None:
    asked, heard = session["asked"], session["heard"]
    off, ok = (asked[name]["at"] for name in ("off", "ok"))

    def first(name: str, after: float, holds: Callable[[Any], bool]) -> float:
        """How long after it was asked a stream first says what is wanted."""
        return next((t - after for t, value in heard[name] if t > after and holds(value)), math.inf)

    delays = {
        "health lost": first("health", off, lambda health: not health["is_global_position_ok"]),
        "all not ok": first("health_all_ok", off, lambda healthy: not healthy),
        "no fix": first("gps_info", off, lambda gps: gps["fix_type"] in ("NO_FIX", "NO_GPS")),
        "said": first("status_text", off, lambda said: "gnss" in said["text"].lower()),
        "health back": first("health", ok, lambda health: health["is_global_position_ok"]),
        "all ok again": first("health_all_ok", ok, bool),
        "fix again": first("gps_info", ok, lambda gps: gps["fix_type"] == "FIX_3D"),
        "said again": first("status_text", ok, lambda said: "gnss" in said["text"].lower()),
    }
    print({name: round(delay, 2) for name, delay in delays.items()})
    late = {name: delay for name, delay in delays.items() if delay > 2}
    assert not late
    before = [health["is_global_position_ok"] for t, health in heard["health"] if off - 1.5 < t < off]
    assert all(before)


def test_a_client_sees_the_estimate_leave_the_truth_and_return(listen: Callable[..., Session]) -> None:
    """Draws what the client heard: the README's picture is a copy."""
    grade = "sensors.imu.grade='mems-consumer'"
    session = listen(15, 8, "--set", grade, "--set", "truth.wind.speed_mps=8", realtime=5)
    heard = session["heard"]
    t, east, north, off = distances(heard)
    healthy = np.array([[at, health["is_global_position_ok"]] for at, health in heard["health"]], dtype=float)
    lost = healthy[healthy[:, 1] == 0, 0]
    lost = lost[lost > session["asked"]["off"]["at"]]
    before = off[(t > lost[0] - 4) & (t < lost[0])].max()
    within = off[(t > lost[0]) & (t < lost[-1])].max()
    after = off[t > lost[-1] + 3].max()
    assert within > 1.5 * before
    assert after < within
    draw(session, (t, east, north, off), (lost[0], lost[-1]), PICTURE)
    assert 10_000 < PICTURE.stat().st_size < 150_000


def distances(heard: Session) -> tuple[Any, Any, Any, Any]:
    """Client's time [s], position east and north of the first [m], and its distance from the ground truth [m]."""
    truth = np.array([[at, p["latitude_deg"], p["longitude_deg"]] for at, p in heard["ground_truth"]])
    seen = np.array([[at, p["latitude_deg"], p["longitude_deg"]] for at, p in heard["position"]])
    seen = seen[(seen[:, 0] > truth[0, 0]) & (seen[:, 0] < truth[-1, 0])]
    lat0, lon0 = seen[0, 1:]
    north, east, _ = pymap3d.geodetic2ned(seen[:, 1], seen[:, 2], 0, lat0, lon0, 0)
    lat, lon = (np.interp(seen[:, 0], truth[:, 0], truth[:, i]) for i in (1, 2))
    true_north, true_east, _ = pymap3d.geodetic2ned(lat, lon, 0, lat0, lon0, 0)
    return seen[:, 0], east, north, np.hypot(north - true_north, east - true_east)


def draw(session: Session, track: tuple[Any, Any, Any, Any], lost: tuple[float, float], path: Path) -> None:
    heard = session["heard"]
    t, east, north, off = track
    stamps = np.array([[at, euler["timestamp_us"] / 1e6] for at, euler in heard["attitude_euler"]])

    def flown(at: Any) -> Any:
        """The vehicle's time at the client's."""
        return np.interp(at, stamps[:, 0], stamps[:, 1])

    figure, axes = plt.subplot_mosaic(
        [["map", "off"], ["map", "attitude"], ["map", "health"]],
        figsize=(9, 4.6),
        height_ratios=[2, 2, 1],
        layout="constrained",
    )
    without = (t > lost[0]) & (t < lost[1])
    axes["map"].plot(east, north, lw=1.2, label="position")
    axes["map"].plot(np.where(without, east, np.nan), north, "C3", lw=1.8, label="position without GNSS")
    axes["map"].plot(east[-1], north[-1], "k>", ms=5)
    axes["map"].set(xlabel="east (m)", ylabel="north (m)", title="Telemetry.position()", aspect="equal")
    axes["map"].legend(fontsize=7, frameon=False)
    axes["off"].plot(flown(t), off, lw=1)
    axes["off"].set(title="distance of position() from ground_truth() (m)")
    for name in ("roll_deg", "pitch_deg"):
        axes["attitude"].plot(
            stamps[:, 1], [euler[name] for _, euler in heard["attitude_euler"]], lw=0.8, label=name[:-4]
        )
    axes["attitude"].set(title="attitude_euler() (deg)")
    axes["attitude"].legend(fontsize=7, frameon=False, ncols=2)
    fixes = np.array([[flown(at), gps["fix_type"] == "FIX_3D"] for at, gps in heard["gps_info"]])
    healthy = np.array([[flown(at), health["is_global_position_ok"]] for at, health in heard["health"]])
    axes["health"].step(fixes[:, 0], fixes[:, 1] + 1.5, where="post", lw=1.2)
    axes["health"].step(healthy[:, 0], healthy[:, 1], where="post", lw=1.2, color="C2")
    axes["health"].set(
        yticks=[0.5, 2], yticklabels=["health()", "gps_info()"], ylim=(-0.3, 2.8), xlabel="vehicle's time (s)"
    )
    for name in ("off", "attitude", "health"):
        axes[name].axvspan(*flown(np.array(lost)), color="C3", alpha=0.12, lw=0)
        axes[name].sharex(axes["off"])
    for axis in axes.values():
        axis.title.set_fontsize(9)
        axis.tick_params(labelsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
