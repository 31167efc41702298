"""A body at rest reads gravity and Earth rate, and an error-free strapdown leaves it where it is."""

import math
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from nav import earth, strapdown
from testbed.kinematic import Kinematic
from testbed.truth import COLUMNS, increments

PLACES = [(34.0, 108.0, 800.0), (-33.0, 180.0, 20.0), (84.0, -40.0, 3000.0), (0.0, -180.0, 0.0)]


def place(lat_deg, lon_deg, alt_m, heading_deg=30.0, pitch_deg=4.0, roll_deg=-7.0):
    return SimpleNamespace(
        lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m, heading_deg=heading_deg, pitch_deg=pitch_deg, roll_deg=roll_deg
    )


@pytest.mark.parametrize("where", PLACES)
def test_reads_gravity_and_earth_rate(where):
    block = Kinematic(place(*where), 200).advance(3)
    lat = math.radians(where[0])
    C_nb = Rotation.from_euler("ZYX", [30.0, 4.0, -7.0], degrees=True).as_matrix()
    # rounding of some 460 m/s of inertial velocity, 200 times a second
    assert block.dv[1] * 200 == pytest.approx(C_nb.T @ [0, 0, -earth.gravity(lat, where[2])], abs=3e-11)
    earth_rate = 7.292115e-5 * np.array([math.cos(lat), 0, -math.sin(lat)])
    assert block.dtheta[1] * 200 == pytest.approx(C_nb.T @ earth_rate, abs=1e-18)
    assert block.omega_b[0] == pytest.approx(C_nb.T @ earth_rate, abs=1e-18)
    assert not block.dtheta[0].any()
    assert not block.dv[0].any()


@pytest.mark.parametrize("where", PLACES)
def test_agrees_with_increments_formed_from_its_rows(where):
    block = Kinematic(place(*where), 200).advance(2001)
    dtheta, dv = increments(block.t, block.lat, block.lon, block.h, block.v_n, block.q_nb)
    assert np.abs(dtheta - block.dtheta).max() < 1e-15
    assert np.abs(dv - block.dv).max() < 1e-12


@pytest.mark.parametrize("where", PLACES)
def test_error_free_strapdown_stays_for_ten_minutes(where):
    block = Kinematic(place(*where), 200).advance(120_001)
    q, v, lla = block.q_nb[0].copy(), np.zeros(3), np.array([block.lat[0], block.lon[0], block.h[0]])
    strapdown.propagate(q, v, lla, block.dtheta[1:], block.dv[1:], np.full(120_000, 1 / 200))
    n, e, d = pymap3d.geodetic2ned(*lla, block.lat[0], block.lon[0], block.h[0], deg=False)
    print(
        f"{where}: {math.hypot(n, e):.1e} m horizontal, {abs(d):.1e} m vertical, {np.abs(q - block.q_nb[0]).max():.1e}"
    )
    assert math.hypot(n, e) < 1e-4
    assert abs(d) < 1e-4
    assert np.abs(q - block.q_nb[0]).max() < 1e-10


def test_rows_do_not_depend_on_how_they_are_asked_for():
    whole = Kinematic(place(*PLACES[0]), 200).advance(50)
    source = Kinematic(place(*PLACES[0]), 200)
    blocks = [source.advance(n) for n in (1, 0, 7, 42)]
    assert [b.tick for b in blocks] == [0, 1, 1, 8]
    for name in COLUMNS:
        assert np.array_equal(np.concatenate([getattr(b, name) for b in blocks]), getattr(whole, name))
    assert whole.t[-1] == 49 / 200


def test_still_standard_air_and_no_engine():
    row = Kinematic(place(*PLACES[0]), 200).advance(1)
    assert row.pressure[0] == pytest.approx(92076, rel=1e-4)  # U.S. Standard Atmosphere 1976 at 800 m
    assert row.temperature[0] == pytest.approx(282.951, abs=1e-2)
    assert row.density[0] == pytest.approx(1.1336, rel=1e-4)
    for name in ("v_n", "wind_n", "airspeed", "alpha", "beta", "engine_rpm", "current", "fuel", "controls"):
        assert not getattr(row, name).any()
    assert row.leg[0] == -1
    assert -math.pi < Kinematic(place(0.0, 540.0, 0.0), 200).advance(1).lon[0] <= math.pi
