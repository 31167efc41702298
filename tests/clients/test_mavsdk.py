"""MAVSDK, what programs for PX4 are written with, hears and asks everything, and breaks the GNSS."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pymap3d
import pytest
from worlds.programs import ROOT, START_S, Program

from testbed import Scenario

pytestmark = pytest.mark.slow
STATION = Path(__file__).parent / "mavsdk_station.py"
PICTURE = ROOT / "runs" / "clients" / "mavsdk.png"

Session = dict[str, Any]


@pytest.fixture
def listen(clients: Path, fly: Callable[..., int], start: Callable[..., Program]) -> Callable[..., Session]:
    """Fly, and let a station wait, fail the GNSS and heal it for so long each; what it was told."""

    def session(seconds: Sequence[float], *arguments: str, realtime: float = 1.0) -> Session:
        port = fly("u_turn", *arguments, realtime=realtime)
        station = start(clients / "python", STATION, f"udpin://127.0.0.1:{port}", *map(str, seconds))
        assert station.wait(START_S) == 0, station.output[-4000:]
        told: Session = json.loads(station.output.splitlines()[-1])
        return told

    return session


def test_everything_answers_and_a_failure_shows(listen: Callable[..., Session]) -> None:
    session = listen([1, 4, 8])
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
    """Draws what the client heard: the picture of README and manual is a copy."""
    changes = ["sensors.imu.grade='mems-consumer'", "estimator[0].aids=['gnss', 'barometer', 'magnetometer']"]
    session = listen([6, 10, 8], *(word for change in changes for word in ("--set", change)), realtime=5)
    seen = Seen(session["heard"])
    before = seen.off[seen.t < seen.lost[0]].max()
    without = seen.off[(seen.t > seen.lost[0]) & (seen.t < seen.lost[1])].max()
    after = seen.off[seen.t > seen.lost[1] + 5].max()
    assert before < 10
    assert without > 3 * before
    assert after < 10
    seen.draw(PICTURE)
    assert 10_000 < PICTURE.stat().st_size < 150_000


def test_program_of_the_manual(
    clients: Path, fly: Callable[..., int], start: Callable[..., Program], tmp_path: Path
) -> None:
    page = (ROOT / "docs/ground-station.md").read_text("utf-8")
    [program] = re.findall(r"^```python [^\n]*\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert program.count("14540") == 1
    (tmp_path / "program.py").write_text(program.replace("14540", str(fly("u_turn"))))
    start(clients / "python", tmp_path / "program.py").expect("gnss (silent|denied)", 30)


class Seen:
    """What a client heard, by the vehicle's own time: where it holds itself to be, where it is, its health."""

    def __init__(self, heard: dict[str, Any]) -> None:
        home = heard["home"][-1][1]
        odometry = [value for _, value in heard["odometry"]]
        truth = [value for _, value in heard["ground_truth"]]
        self.t = np.array([value["time_usec"] / 1e6 for value in odometry])
        self.north, self.east = (np.array([one["position_body"][axis] for one in odometry]) for axis in ("x_m", "y_m"))
        at = [value["timestamp_us"] / 1e6 for value in truth]
        lat, lon = (np.array([value[f"{angle}_deg"] for value in truth]) for angle in ("latitude", "longitude"))
        north, east, _ = pymap3d.geodetic2ned(lat, lon, 0, home["latitude_deg"], home["longitude_deg"], 0)
        self.true_north, self.true_east = np.interp(self.t, at, north), np.interp(self.t, at, east)
        self.off = np.hypot(self.east - self.true_east, self.north - self.true_north)
        self.euler = {
            name: np.array(
                [[value["timestamp_us"] / 1e6, value[f"{name}_deg"]] for _, value in heard["attitude_euler"]]
            )
            for name in ("roll", "pitch")
        }
        came = [time for time, _ in heard["attitude_euler"]]  # health and fix bear no time of their own
        self.fix = self._steps(came, heard["gps_info"], lambda gps: gps["fix_type"] == "FIX_3D")
        self.health = self._steps(came, heard["health"], lambda health: health["is_global_position_ok"])
        ill = self.health[np.flatnonzero((self.health[:, 1] == 0) & (self.health[:, 0] > self.t[0] + 5)), 0]
        self.lost = ill[0], ill[-1]

    def _steps(self, came: list[float], values: list[Any], holds: Callable[[Any], bool]) -> Any:
        times = np.interp([time for time, _ in values], came, self.euler["roll"][:, 0])
        return np.column_stack([times, [holds(value) for _, value in values]])

    def draw(self, path: Path) -> None:
        figure, axes = plt.subplot_mosaic(
            [["map", "off"], ["map", "attitude"], ["map", "health"]],
            figsize=(9, 4.2),
            width_ratios=[1, 1],
            height_ratios=[2, 2, 1],
            layout="constrained",
        )
        without = (self.t > self.lost[0]) & (self.t < self.lost[1])
        axes["map"].plot(self.true_east, self.true_north, "k--", lw=0.8, label="ground_truth()")
        axes["map"].plot(self.east, np.where(without, np.nan, self.north), lw=1.5, label="odometry()")
        axes["map"].plot(self.east, np.where(without, self.north, np.nan), "C3", lw=1.5, label="without GNSS")
        axes["map"].set(xlabel="east of home (m)", ylabel="north of home (m)")
        axes["map"].set_aspect("equal", adjustable="datalim")
        axes["map"].legend(fontsize=7, frameon=False)
        axes["off"].plot(self.t, self.off, lw=1)
        axes["off"].set(title="distance of odometry() from ground_truth() (m)")
        for name, values in self.euler.items():
            axes["attitude"].plot(*values.T, lw=0.8, label=name)
        axes["attitude"].set(title="attitude_euler() (deg)")
        axes["attitude"].legend(fontsize=7, frameon=False, ncols=2)
        axes["health"].step(self.fix[:, 0], self.fix[:, 1] + 1.5, where="post", lw=1.2)
        axes["health"].step(self.health[:, 0], self.health[:, 1], where="post", lw=1.2, color="C2")
        axes["health"].set(yticks=[0.5, 2], yticklabels=["health()", "gps_info()"], ylim=(-0.3, 2.8), xlabel="time (s)")
        for name in ("off", "attitude", "health"):
            axes[name].axvspan(*self.lost, color="C3", alpha=0.12, lw=0)
            axes[name].set_xlim(0, self.t[-1])
        for axis in axes.values():
            axis.title.set_fontsize(9)
            axis.tick_params(labelsize=7)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
        plt.close(figure)
