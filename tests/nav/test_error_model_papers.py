"""The papers' lists of states: names, sizes, and F against an independent mechanisation differentiated by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nav import ahrs
from nav.aids import BodyVelocityAid, GnssAid
from nav.aids.base import aid_blocks
from nav.earth import earth_rate_n, gravity
from nav.error_model import PAPERS, ErrorModel, ImuModel
from nav.observability import continuous, state_names

PLAIN = ImuModel(1e-4, 1e-3, 1e-4, 0.05)
DRIFT_S, SCALED = 3600.0, 1e-5
RICH = ImuModel(
    1e-4, 1e-3, 1e-4, 0.05, gyro_drift_sigma=1e-6, gyro_drift_correlation_s=DRIFT_S, gyro_scale_sigma=SCALED,
    accel_scale_sigma=SCALED,
)  # fmt: skip
GPS = GnssAid("gps", (0, 0, 0), True, (5.0,) * 3, 300.0, (0.05,) * 3, 60.0)
DOPPLER = BodyVelocityAid("doppler", scale_sigma=1e-3, error_sigma=0.05, error_correlation_s=200.0)


def axes(block, which="xyz"):
    return [f"{block} {axis}" for axis in {"xyz": "xyz", "NED": ("north", "east", "down"), "NE": ("north", "east"),
                                           "123": "123"}[which]]  # fmt: skip


PHI, DV, DP, DV_2, DP_2 = axes("phi", "NED"), axes("dv", "NED"), axes("dp", "NED"), axes("dv", "NE"), axes("dp", "NE")
GYRO, ACCEL = axes("gyro_bias"), axes("accel_bias")
INS = [*PHI, *DV, *DP, *GYRO, *ACCEL]
CUI_B = [*DP, *DV, *PHI, *GYRO, *axes("gyro_drift"), *ACCEL, *axes("gyro_scale"), *axes("accel_scale")]
OF_AIDS = [
    *axes("gps_position_error", "123"), *axes("gps_velocity_error", "123"), *axes("doppler_error", "123"),
    *axes("doppler_scale", "123"),
]  # fmt: skip
LISTS = {
    "cui2022_a": (PLAIN, INS, 15),
    "cui2022_b": (RICH, CUI_B, 24),
    "zhou2025": (PLAIN, INS, 15),
    "cheng2020": (PLAIN, [*DV_2, *DP_2, *PHI, *ACCEL, *GYRO], 13),
    "zhu2020": (PLAIN, [*DP_2, *DV_2, *PHI, *GYRO, *ACCEL], 13),
    "jiang2021": (PLAIN, [*PHI, *GYRO], 6),
}
A, E2 = 6378137.0, 0.00669437999014
WIE = 7.292115e-5


def test_every_paper_has_its_list():
    assert PAPERS.keys() == LISTS.keys()


@pytest.mark.parametrize("paper", LISTS)
def test_names_and_size(paper):
    imu, names, size = LISTS[paper]
    model = ErrorModel(imu)
    places = model.places(PAPERS[paper])
    assert [state_names(model)[k] for k in places] == names
    assert len(set(places.tolist())) == size


def test_states_of_cui_with_the_errors_of_receiver_and_radar():
    model = ErrorModel(RICH, aid_blocks([GPS, DOPPLER]))
    assert model.size == 24 + 6 + 6
    of_aids = dict.fromkeys((*GPS.states[:2], "doppler_error", "doppler_scale"), (0, 1, 2))
    places = model.places({**PAPERS["cui2022_b"], **of_aids})
    assert [state_names(model)[k] for k in places] == CUI_B + OF_AIDS
    assert sorted(places) == list(range(36))
    # the first 24 grow as without; of the rest, receiver and radar forget, the radar's scale stays
    F = continuous(model, *nominal(True), FORCE, RATE)[np.ix_(places, places)]
    alone = ErrorModel(RICH)
    where = alone.places(PAPERS["cui2022_b"])
    np.testing.assert_array_equal(F[:24, :24], continuous(alone, *nominal(True), FORCE, RATE)[np.ix_(where, where)])
    np.testing.assert_allclose(
        F[24:, 24:], np.diag(np.repeat([-1 / 300, -1 / 60, -1 / 200, 0.0], 3)), rtol=1e-12, atol=0
    )
    assert not F[:24, 24:].any()
    assert not F[24:, :24].any()


def test_a_block_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"no block gyro_drift among phi, dv"):
        ErrorModel(PLAIN).places(PAPERS["cui2022_b"])


FORCE, RATE = np.array([1.3, -0.8, -10.1]), np.array([0.21, -0.13, 0.34])


def nominal(moving):
    q = Rotation.from_euler("ZYX", [2.1, -0.1, 0.4]).as_quat()
    v_n = np.array([62.0, -47.0, 3.0]) if moving else np.zeros(3)
    return q[[3, 0, 1, 2]], v_n, np.array([np.radians(38.0), 0.2, 900.0])


def curvature(lat):
    """Meridian and prime-vertical radius."""
    W2 = 1 - E2 * np.sin(lat) ** 2
    return A * (1 - E2) / W2**1.5, A / np.sqrt(W2)


def skew(w):
    """[w x]"""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def per_radian(place):
    """Metres north, east, down per unit of latitude, longitude, height."""
    R_M, R_N = curvature(place[0])
    return np.array([R_M + place[2], (R_N + place[2]) * np.cos(place[0]), -1.0])


def mechanisation(C_nb, v, place, f_b, omega_b):
    """C', v', (lat, lon, h)' of the navigation equations, NED."""
    lat, _, h = place
    R_M, R_N = curvature(lat)
    ie = WIE * np.array([np.cos(lat), 0, -np.sin(lat)])
    en = np.array([v[1] / (R_N + h), -v[0] / (R_M + h), -v[1] * np.tan(lat) / (R_N + h)])
    turn_b, turn_n = skew(omega_b), skew(ie + en)
    fall = np.array([0, 0, float(gravity(lat, h))])
    return (
        C_nb @ turn_b - turn_n @ C_nb,
        C_nb @ f_b + fall - np.cross(2 * ie + en, v),
        np.array([v[0] / (R_M + h), v[1] / ((R_N + h) * np.cos(lat)), -v[2]]),
    )


STEPS = {"phi": 1e-5, "dv": 0.1, "dp": 1000.0, "gyro": 1e-4, "accel": 1e-3}


def rate_of_error(name, size, moving):
    """d/dt of (phi, dv, dp) when the estimate differs from the truth by ``size`` in the one state ``name``."""
    block, axis = name.split()
    axis = ("north", "east", "down").index(axis) if axis in ("north", "east", "down") else "xyz".index(axis)
    unit = np.eye(3)[axis] * size
    q, v, place = nominal(moving)
    C = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    metres = per_radian(place)
    C_hat, v_hat, place_hat, f_hat, omega_hat = C, v, place, FORCE, RATE
    match block:
        case "phi":
            C_hat = (np.eye(3) - skew(unit)) @ C
        case "dv":
            v_hat = v + unit
        case "dp":
            place_hat = place + unit / metres
        case "gyro_bias" | "gyro_drift":
            omega_hat = RATE - unit
        case "gyro_scale":
            omega_hat = RATE / (1 + unit)
        case "accel_bias":
            f_hat = FORCE - unit
        case "accel_scale":
            f_hat = FORCE / (1 + unit)
    (dC, dv, dplace), (dC_hat, dv_hat, dplace_hat) = (
        mechanisation(C, v, place, FORCE, RATE), mechanisation(C_hat, v_hat, place_hat, f_hat, omega_hat)
    )  # fmt: skip
    turn = -(dC_hat @ C.T + C_hat @ dC.T)  # [phi x]' of I - C_hat C'
    dphi = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    stretch = (per_radian(place + dplace) - per_radian(place - dplace)) / 2  # metres'
    dp = metres * (dplace_hat - dplace) + stretch * (place_hat - place)
    return np.concatenate([dphi, dv_hat - dv, dp])


@pytest.mark.parametrize("paper", LISTS)
def test_F_is_the_derivative_of_the_mechanisation(paper):
    imu, names, size = LISTS[paper]
    moving = paper != "jiang2021"  # which is at rest relative to the Earth
    model = ErrorModel(imu)
    places = model.places(PAPERS[paper])
    F = continuous(model, *nominal(moving), FORCE, RATE)[np.ix_(places, places)]

    motion = dict(zip([*PHI, *DV, *DP], range(9), strict=True))
    expected = np.zeros((size, size))
    for column, name in enumerate(names):
        step = STEPS[name.split()[0].split("_")[0]]
        slope = (rate_of_error(name, step, moving) - rate_of_error(name, -step, moving)) / (2 * step)
        for row, moved in enumerate(names):
            if moved in motion:
                expected[row, column] = slope[motion[moved]]
        if name.startswith("gyro_drift"):
            expected[column, column] = -1 / DRIFT_S
    # Each element against the largest of its row in its block. Left out of F: how radii and gravity change with
    # latitude, 1 % of v / R^2 and of v^2 / R^2 at the most, and 0.5 % of g / R.
    v, R = np.linalg.norm(nominal(moving)[1]), 6.37e6
    left_out = {"phi": 1.5 * E2 * v / R**2, "dv": 1.5 * E2 * v**2 / R**2, "dp": 0.0}
    blocks = np.array([name.split()[0] for name in names])
    for row, name in enumerate(names):
        for block in dict.fromkeys(blocks):
            a, b = F[row, blocks == block], expected[row, blocks == block]
            tolerance = 0.01 * np.abs(b).max()
            if block == "dp" and name in motion:
                tolerance += left_out[name.split()[0]] + (9.8 * 0.0053 / R if name == "dv down" else 0)
            np.testing.assert_allclose(a, b, rtol=0, atol=tolerance + 1e-17, err_msg=f"{name}, {block}")
    assert np.count_nonzero(expected) > size


def test_F_of_jiang_is_equation_5_written_out():
    """phi_N' = -w_ie sinL phi_E, phi_U' = w_ie cosL phi_E, phi_E' = w_ie sinL phi_N - w_ie cosL phi_U, each less the
    row of C_b^n eps; north, up, east of n and forward, up, right of b. Their eps is minus our error of the estimate.
    """
    model = ErrorModel(PLAIN)
    places = model.places(PAPERS["jiang2021"])
    q, v, place = nominal(False)
    ours = continuous(model, q, v, place, FORCE, RATE)[np.ix_(places, places)]
    n, u = WIE * np.cos(place[0]), WIE * np.sin(place[0])
    turned = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # north-east-down to north-up-east, and so for b
    C = turned @ Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix() @ turned.T
    printed = np.zeros((6, 6))
    printed[:3, :3] = [[0, 0, -u], [0, 0, n], [u, -n, 0]]
    printed[:3, 3:] = -C
    to_paper = np.kron(np.diag([1, -1]), turned)
    np.testing.assert_allclose(to_paper @ ours @ to_paper.T, printed, rtol=1e-9, atol=1e-17)
    # and what the filter flies is one step of it
    T = 0.01
    C_ours = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    flown = ahrs.transition(C_ours * T, earth_rate_n(place[0]), T)
    np.testing.assert_allclose(flown, (np.eye(6) + ours * T)[:3], rtol=1e-12, atol=1e-18)
