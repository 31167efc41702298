"""The airframe: trims, modes, propulsion, actuators. Oracles are textbook formulas on the published derivatives."""

from __future__ import annotations

import math
import re
import shutil
from array import array
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from testbed import Scenario, run
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion.aircraft import load
from testbed.motion.flight import Flight
from testbed.motion.legs import Leg
from testbed.motion.model import FOOT, POUND, Aircraft
from testbed.motion.modes import modes, modes_table, trim_and_modes
from testbed.motion.sections import FlightTruth, Start

LOITER = load("loiter")
AIRSPEEDS = [20.0, 22.5, 25.0, 27.5, 30.0, 32.5, 35.0]
# Wing area, span, chord [m], mass [kg], inertias [kg m^2].
S, B, C, MASS = 0.55, 2.8956, 0.189941, 13.5
JX, JY, JZ, JXZ = 0.8244, 1.135, 1.759, 0.1204


@pytest.fixture(scope="module")
def aircraft() -> Aircraft:
    return Aircraft("loiter", 200.0)


def level(alt: float, airspeed: float) -> Start:
    return Start(lat_deg=0.0, lon_deg=0.0, alt_m=alt, heading_deg=0.0, airspeed_mps=airspeed)


def values(aircraft: Aircraft, *names: str) -> list[float]:
    return [aircraft.fdm[name] for name in names]


def climbing(aircraft: Aircraft, airspeed: float, alt: float, seconds: float, rate: float = 0.0) -> None:
    """Fly on the inner loops with the altitude command rising at ``rate``."""
    for tick in range(round(seconds * 20)):
        aircraft.command(0.0, alt + rate * tick / 20, rate, airspeed)
        aircraft.run(10, array("d"))


@pytest.mark.ci
@pytest.mark.parametrize("airspeed", AIRSPEEDS)
@pytest.mark.parametrize("alt", [50.0, 800.0])
def test_trims(aircraft: Aircraft, airspeed: float, alt: float) -> None:
    aircraft.start(level(alt, airspeed))
    accelerations = values(aircraft, *(f"accelerations/{axis}dot-ft_sec2" for axis in "uvw"))
    angular = values(aircraft, *(f"accelerations/{axis}dot-rad_sec2" for axis in "pqr"))
    assert np.abs(accelerations).max() * FOOT < 0.02
    assert np.abs(angular).max() < 0.02
    assert aircraft.fdm["velocities/vt-fps"] * FOOT == pytest.approx(airspeed, abs=0.05)
    assert aircraft.fdm["position/geod-alt-ft"] * FOOT == pytest.approx(alt, abs=1e-3)
    elevator, throttle = values(aircraft, "fcs/elevator-pos-rad", "fcs/throttle-pos-norm")
    assert abs(elevator) < 0.9 * 0.52
    assert 0.1 < throttle < 0.8
    # Lift carries the weight: an independent sum of the published lift curve below the stall.
    alpha = aircraft.fdm["aero/alpha-rad"]
    q = 0.5 * aircraft.fdm["atmosphere/rho-slugs_ft3"] * 515.378818 * airspeed**2
    lift = q * S * (0.23 + 5.6106 * alpha + 0.13 * elevator)
    thrust = aircraft.fdm["propulsion/engine/thrust-lbs"] * 4.4482216
    assert lift + thrust * math.sin(alpha) == pytest.approx(MASS * 9.80, rel=0.03)


def test_mass_and_inertia_are_the_published_ones(aircraft: Aircraft) -> None:
    aircraft.start(level(800.0, 25.0))
    mass, *inertia = values(aircraft, "inertia/mass-slugs", *(f"inertia/i{a}-slugs_ft2" for a in ("xx", "yy", "zz")))
    assert mass * 14.593903 == pytest.approx(MASS, rel=1e-3)
    assert np.array(inertia) * 1.3558179 == pytest.approx([JX, JY, JZ], rel=1e-3)


@pytest.mark.ci
@pytest.mark.parametrize("airspeed", AIRSPEEDS)
def test_modes_are_stable_and_where_textbooks_put_them(airspeed: float) -> None:
    found = {mode.name: mode for mode in modes(airspeed, 0.0)}
    for mode in found.values():
        assert mode.eigenvalue.real < 0
    assert found["spiral"].time_constant > 15  # slow, or there would be too much dihedral
    q, half = 0.5 * 1.225 * airspeed**2, 2 * airspeed
    # Roll subsidence, p alone.
    assert found["roll"].eigenvalue.real == pytest.approx(-0.5051 * q * S * B**2 / half / JX, rel=0.2)
    # Short period, second order in (alpha, q).
    z_w = -q * S * 5.6106 / (MASS * airspeed)
    m_alpha, m_q, m_adot = (q * S * C / JY * k for k in (-2.7397, -38.2067 * C / half, -10.3796 * C / half))
    short = found["short period"]
    assert abs(short.eigenvalue) == pytest.approx(math.sqrt(z_w * m_q - m_alpha), rel=0.2)
    assert -2 * short.eigenvalue.real == pytest.approx(-(z_w + m_q + m_adot), rel=0.2)
    # Lanchester's phugoid.
    assert abs(found["phugoid"].eigenvalue) == pytest.approx(math.sqrt(2) * 9.8 / airspeed, rel=0.2)
    # Dutch roll as weathercock oscillation.
    n_beta = 0.0726 * q * S * B / JZ
    assert abs(found["Dutch roll"].eigenvalue) == pytest.approx(math.sqrt(n_beta), rel=0.35)
    assert 0.05 < found["Dutch roll"].damping < 0.7


@pytest.mark.ci
def test_modes_table_is_complete() -> None:
    table = modes_table([25.0]).splitlines()
    assert len(table) == 2 + 5
    assert all(row.count("|") == 7 for row in table)


@pytest.mark.ci
def test_short_period_and_phugoid_are_seen_in_flight(aircraft: Aircraft) -> None:
    """The linearisation against a flight of the bare airframe: kicked in pitch, hands off."""
    aircraft = Aircraft("loiter", 200.0)
    aircraft.start(level(800.0, 25.0))
    fdm = aircraft.fdm
    for surface, travel in {"aileron": 0.35, "elevator": 0.52, "rudder": 0.35}.items():
        fdm[f"fcs/{surface}-cmd-norm"] = fdm[f"fcs/{surface}-pos-rad"] / travel
    fdm["fcs/throttle-cmd-norm"] = fdm["fcs/throttle-pos-norm"]
    fdm["ap/engaged"], fdm["ap/hold"] = 0.0, -1.0
    fdm["fcs/elevator-cmd-norm"] -= 0.03
    aircraft.run(200, array("d"))
    fdm["fcs/elevator-cmd-norm"] += 0.03
    speed = []
    for _ in range(200 * 40):
        fdm.run()
        speed.append(fdm["velocities/vt-fps"])
    swing = np.array(speed) - np.mean(speed)
    crossings = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0)) / 200
    phugoid = next(mode for mode in modes(25.0) if mode.name == "phugoid")
    assert np.diff(crossings).mean() == pytest.approx(phugoid.period, rel=0.1)


@pytest.mark.ci
def test_thrust_falls_with_airspeed(aircraft: Aircraft) -> None:
    """At the same throttle, in the same air."""
    thrusts = []
    for airspeed in (20.0, 25.0, 30.0, 35.0):
        aircraft.start(level(100.0, airspeed))
        aircraft.linearise()  # freezes the airframe and hands the throttle over
        aircraft.fdm["fcs/throttle-cmd-norm"] = 0.8
        aircraft.run(1000, array("d"))
        thrusts.append(aircraft.fdm["propulsion/engine/thrust-lbs"] * 4.4482216)
        for integrator, number in {"rate/rotational": 3, "rate/translational": 3}.items():
            aircraft.fdm[f"simulation/integrator/{integrator}"] = number
        aircraft.fdm["simulation/integrator/position/rotational"] = 7
        aircraft.fdm["simulation/integrator/position/translational"] = 4
    assert np.all(np.diff(thrusts) < -2.0)
    assert 10 < thrusts[-1] < thrusts[0] < 60


@pytest.mark.ci
def test_engine_against_its_published_map(aircraft: Aircraft) -> None:
    """Full throttle at low altitude: power and fuel flow of the published table within a fifth."""
    fdm = aircraft.fdm
    aircraft.start(level(30.0, 35.0))
    climbing(aircraft, 60.0, 30.0, 8.0)
    rpm, hp, pps = values(
        aircraft, "propulsion/engine/engine-rpm", "propulsion/engine/power-hp", "propulsion/engine/fuel-flow-rate-pps"
    )
    assert fdm["fcs/throttle-pos-norm"] == 1.0
    assert 6500 < rpm < 8500
    power = np.interp(rpm, [6000, 7000], [1193.81, 1429.42]) / 745.7
    assert hp == pytest.approx(power, rel=0.2)
    assert pps * POUND * 3600 == pytest.approx(np.interp(rpm, [6000, 7000], [0.337, 0.408]), rel=0.2)


@pytest.mark.ci
def test_climbs_as_the_plan_check_believes(aircraft: Aircraft) -> None:
    for airspeed, alt in [(21.0, 100.0), (25.0, 100.0), (32.0, 100.0), (27.0, 2500.0), (34.0, 2500.0)]:
        for rate in (LOITER.climb_limit(airspeed, alt), -LOITER.descent_limit(airspeed, alt)):
            aircraft.start(level(alt, airspeed))
            climbing(aircraft, airspeed, alt, 40.0, rate)
            height, speed, throttle = values(
                aircraft, "position/geod-alt-ft", "velocities/vt-fps", "fcs/throttle-pos-norm"
            )
            assert height * FOOT - (alt + rate * 40) == pytest.approx(0.0, abs=2.0)
            assert speed * FOOT == pytest.approx(airspeed, abs=1.5)
            assert throttle < 0.99


def test_actuators_lag_and_keep_to_rate_and_travel(aircraft: Aircraft) -> None:
    aircraft = Aircraft("loiter", 200.0)
    aircraft.start(level(800.0, 25.0))
    fdm = aircraft.fdm
    fdm["ap/engaged"], fdm["ap/hold"] = 0.0, -1.0
    fdm.run()

    def respond(command: float) -> np.ndarray:
        fdm["fcs/aileron-cmd-norm"] = command
        seen = []
        for _ in range(60):
            fdm.run()
            seen.append(fdm["fcs/aileron-pos-rad"])
        return np.array(seen)

    respond(0.0)
    large = respond(5.0)
    assert large.max() == pytest.approx(0.35)
    assert np.diff(large).max() == pytest.approx(3.5 / 200, rel=1e-6)
    respond(0.0)
    small = respond(0.02) / (0.02 * 0.35)
    assert small[7] == pytest.approx(1 - math.exp(-25 * 8 / 200), abs=0.08)  # a lag of 40 ms


# --- the flying wing


WING = load("flying_wing")


@pytest.fixture(scope="module")
def wing() -> Aircraft:
    return Aircraft("flying_wing", 200.0)


@pytest.mark.parametrize("airspeed", [12.5, 18.0, 25.0])
def test_trims_of_the_wing(wing: Aircraft, airspeed: float) -> None:
    wing.start(level(280.0, airspeed))
    fdm = wing.fdm
    assert np.abs(values(wing, *(f"accelerations/{axis}dot-ft_sec2" for axis in "uvw"))).max() * FOOT < 0.02
    assert fdm["velocities/vt-fps"] * FOOT == pytest.approx(airspeed, abs=0.02)
    alpha, elevator, throttle = values(wing, "aero/alpha-rad", "fcs/elevator-pos-rad", "fcs/throttle-pos-norm")
    rho = fdm["atmosphere/rho-slugs_ft3"] * 515.378818
    q_s = 0.5 * rho * airspeed**2 * 0.75
    thrust, rps = fdm["propulsion/engine/thrust-lbs"] * POUND * 9.80665, fdm["propulsion/engine/engine-rpm"] / 60
    # Published coefficients: lift carries the weight, thrust the drag, no moment is left.
    assert q_s * (0.0867 + 4.0203 * alpha + 0.2781 * elevator) == pytest.approx(3.364 * 9.80, rel=0.02)
    drag = q_s * (0.0197 + 0.0791 * alpha + 1.0555 * alpha**2 + 0.0633 * elevator**2)
    assert thrust == pytest.approx(drag, rel=0.03)
    assert 0.02275 - 0.4629 * alpha - 0.2292 * elevator == pytest.approx(0.0, abs=2e-3)
    # The propeller's fit, and the motor: its power is what the propeller takes, at the current that the voltage drives.
    j = airspeed / (rps * 0.3302)
    assert thrust == pytest.approx((0.09357 - 0.06044 * j - 0.1079 * j**2) * rho * rps**2 * 0.3302**4, rel=0.02)
    power = 2 * math.pi * (0.00523 + 0.00497 * j - 0.01664 * j**2) * rho * rps**3 * 0.3302**5
    back_emf = rps * 60 / 700
    current = (14.8 * throttle - back_emf) / 0.05
    assert fdm["propulsion/engine/current-amperes"] == pytest.approx(current, abs=0.2)
    assert power == pytest.approx(back_emf * (current - 1.0), rel=0.05)
    assert 0.3 < throttle < 0.9


def test_the_wing_stalls_where_its_envelope_says() -> None:
    """Level at 1 g with the elevons that trim asks for: the greatest lift coefficient of the blended curve."""
    alpha = np.linspace(0.0, 0.3, 301)
    below, above = np.exp(-50 * (alpha - 0.26)), np.exp(50 * (alpha + 0.26))
    share = (1 + below + above) / ((1 + below) * (1 + above))  # Beard and McLain, equation 4.10
    curve = (1 - share) * (0.0867 + 4.0203 * alpha) + share * 2 * np.sin(alpha) ** 2 * np.cos(alpha)
    trimmed = curve + 0.2781 * (0.02275 - 0.4629 * alpha) / 0.2292
    stall = math.sqrt(3.364 * 9.80 / (0.5 * 1.225 * 0.75 * trimmed.max()))
    assert WING.airspeed.stall_mps == pytest.approx(stall, rel=0.02)


@pytest.mark.ci
@pytest.mark.parametrize("airspeed", [12.5, 18.0, 25.0])
def test_modes_of_the_wing_are_stable_and_where_textbooks_put_them(airspeed: float) -> None:
    found = {mode.name: mode for mode in modes(airspeed, 0.0, "flying_wing")}
    q_s, half = 0.5 * 1.225 * airspeed**2 * 0.75, 2 * airspeed
    for mode in found.values():
        assert mode.eigenvalue.real < 0
    assert found["roll"].eigenvalue.real == pytest.approx(-0.4042 * q_s * 2.1**2 / half / 0.340, rel=0.2)
    z_w = -q_s * 4.0203 / (3.364 * airspeed)
    m_alpha, m_q = (q_s * 0.357143 / 0.165 * k for k in (-0.4629, -1.3012 * 0.357143 / half))
    short = found["short period"]
    assert abs(short.eigenvalue) == pytest.approx(math.sqrt(z_w * m_q - m_alpha), rel=0.2)
    assert -2 * short.eigenvalue.real == pytest.approx(-(z_w + m_q), rel=0.2)
    assert abs(found["phugoid"].eigenvalue) == pytest.approx(math.sqrt(2) * 9.8 / airspeed, rel=0.2)
    assert abs(found["Dutch roll"].eigenvalue) == pytest.approx(math.sqrt(0.0283 * q_s * 2.1 / 0.400), rel=0.35)
    assert 0.2 < found["Dutch roll"].damping < 0.7


@pytest.mark.ci
def test_the_wing_climbs_as_the_plan_check_believes(wing: Aircraft) -> None:
    for airspeed, alt in [(12.5, 100.0), (18.0, 100.0), (25.0, 100.0), (27.0, 2500.0)]:
        for rate in (WING.climb_limit(airspeed, alt), -WING.descent_limit(airspeed, alt)):
            wing.start(level(alt, airspeed))
            climbing(wing, airspeed, alt, 40.0, rate)
            height, speed, throttle = values(wing, "position/geod-alt-ft", "velocities/vt-fps", "fcs/throttle-pos-norm")
            assert height * FOOT - (alt + rate * 40) == pytest.approx(0.0, abs=0.5)
            assert speed * FOOT == pytest.approx(airspeed, abs=0.2)
            assert throttle < 0.97


@pytest.mark.ci
@pytest.mark.parametrize(
    ("airspeed", "gusts"), [(12.5, "light"), (15.0, "moderate"), (18.0, "moderate"), (25.0, "moderate")]
)
def test_the_wing_flies_in_gusts(airspeed: float, gusts: str) -> None:
    start = {"lat_deg": 34.0, "lon_deg": 108.0, "alt_m": 280.0, "heading_deg": 30.0, "airspeed_mps": airspeed}
    wind = {"from_deg": 250.0, "speed_mps": 5.0, "turbulence": gusts}
    truth = FlightTruth(source="flight", aircraft="flying_wing", start=start, wind=wind)  # type: ignore[arg-type]
    plan = TypeAdapter(list[Leg]).validate_python([{"leg": "loiter", "radius_m": 250, "duration_s": 90}])
    source = Flight(truth, plan, 3)
    flown = source.advance(90 * 200)
    assert source.failure == ""
    assert len(flown) == 90 * 200
    assert np.abs(flown.h - 280.0).max() < 8.0
    assert np.std(flown.airspeed - airspeed) < 1.3
    assert np.degrees(np.abs(flown.omega_b).std(axis=0)).max() < 8.0
    assert np.abs(flown.controls[:, :3]).mean() < 0.3


def test_a_copy_whose_model_was_not_renamed_is_told_so(tmp_path: Path) -> None:
    shutil.copytree(data_dir("aircraft") / "loiter", tmp_path / "mine")
    with pytest.raises(UserError, match=r"mine\.xml: is missing: .*; rename loiter\.xml"):
        load(str(tmp_path / "mine"))


@pytest.mark.ci
@pytest.mark.parametrize(("part", "instead", "says"), [
    (r"<aerodynamics>.*</aerodynamics>", "", "JSBSim can't fly it: A proper axis type has NOT been selected"),
    (r"(<wingarea[^>]*>)[^<]*", r"\1 0 ", "can't be flown: its state is not finite at the start"),
    (r"(<ixx[^>]*>)[^<]*", r"\1 -1 ", "can't be flown: its state is not finite at the start"),
    (r"(<contents[^>]*>)[^<]*", r"\1 0 ", "can't hold 25 m/s true airspeed at"),
    (r"(<emptywt[^>]*>)[^<]*", r"\1 100 ", "can't hold 25 m/s true airspeed at"),
])  # fmt: skip
def test_an_aircraft_that_cannot_be_flown_is_named(tmp_path: Path, part: str, instead: str, says: str) -> None:
    home = tmp_path / "broken"
    shutil.copytree(data_dir("aircraft") / "loiter", home)
    text = (home / "loiter.xml").read_text("utf-8")
    (home / "loiter.xml").unlink()
    (home / "broken.xml").write_text(re.sub(part, instead, text, count=1, flags=re.DOTALL), "utf-8")
    with pytest.raises(UserError, match=re.escape(f"{home / 'broken.xml'}: {says}")):
        trim_and_modes(str(home), 25.0, 300.0)
    keys = {"truth.aircraft": str(home), "truth.start.airspeed_mps": 25.0, "duration_s": 1, "expect": {}}
    with pytest.raises(UserError, match=re.escape(f"{home / 'broken.xml'}: {says}")):
        run(Scenario.load("u_turn", keys))


@pytest.mark.parametrize("part", ['<output name="{}" type="CSV" rate="10"/>', '<input port="1137"/>'])
def test_a_model_that_opens_files_or_ports_is_refused(part: str, tmp_path: Path) -> None:
    """JSBSim wrote over a file of the user's as it read the model."""
    own = tmp_path / "own.csv"
    own.write_text("mine")
    shutil.copytree(data_dir("aircraft") / "loiter", tmp_path / "mine")
    text = (tmp_path / "mine/loiter.xml").read_text("utf-8")
    (tmp_path / "mine/mine.xml").write_text(text.replace("</fdm_config>", f"{part.format(own)}</fdm_config>"), "utf-8")
    with pytest.raises(UserError, match=r"mine\.xml: has <(output|input)>, by which JSBSim"):
        Aircraft(str(tmp_path / "mine"), 200.0)
    assert own.read_text() == "mine"
