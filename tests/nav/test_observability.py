"""Observability: the published table, ranks found symbolically small, and a flight whose answer is known."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from worlds.ins import flight

from nav.earth import earth_rate_n, gravity
from nav.error_model import Block, ErrorModel, ImuModel, markov, transition
from nav.observability import (
    Segment,
    along,
    analyse,
    continuous,
    derivatives,
    flown,
    in_units,
    state_names,
    strippable,
    stripped,
    total,
)

G = 9.806
LAT = np.radians(45)
WIE = 7.292115e-5
RADIUS = 6.378e6
DV_E, DP, PHI_E, PHI_N, PHI_U, NABLA, EPS = 0, slice(2, 4), 4, 5, 6, slice(7, 10), slice(10, 13)


def paper_F(heading=0.0):
    """Cheng et al. 2020 at rest: dV (E, N), dp (north, east, in metres), phi (E, N, U), nabla (3), eps (3)."""
    F = np.zeros((13, 13))
    c, s = np.cos(heading), np.sin(heading)
    C = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    w_n, w_u = WIE * np.cos(LAT), WIE * np.sin(LAT)
    F[0:2, 4:7] = [[0, -G, 0], [G, 0, 0]]
    F[0:2, NABLA] = C[:2]
    F[0, 1], F[1, 0] = 2 * w_u, -2 * w_u
    F[2, 1] = F[3, 0] = 1.0
    F[4:7, 4:7] = [[0, w_u, -w_n], [-w_u, 0, 0], [w_n, 0, 0]]
    F[4, 1], F[5, 0], F[6, 0] = -1 / RADIUS, 1 / RADIUS, np.tan(LAT) / RADIUS
    F[5, 2], F[6, 2] = -w_u / RADIUS, w_n / RADIUS
    F[4:7, EPS] = -C
    return F


VELOCITY, POSITION, HEADING = np.eye(2, 13), np.eye(2, 13, 2), np.eye(1, 13, PHI_U)
BOTH = np.vstack([VELOCITY, POSITION])
ALL = np.vstack([BOTH, HEADING])


@pytest.mark.parametrize("H", [VELOCITY, BOTH])
def test_table_1(H):
    """9.857 = sqrt(g^2 + 1), 9.806 = g, 1, and 5.06e-4 = g w_ie cos 45 deg (printed: 9.86, 9.80, 1, 5.66e-4)."""
    found = analyse(derivatives(Segment(paper_F(), H, 60.0)), 1e-8, reference=DV_E)
    np.testing.assert_allclose(found.degree[[PHI_E, PHI_N]], np.hypot(G, 1), rtol=1e-4)
    np.testing.assert_allclose(found.degree[EPS], [G, G, G * WIE * np.cos(LAT)], rtol=1e-4)
    np.testing.assert_allclose(found.degree[EPS][2], 5.06e-4, rtol=1e-3)
    np.testing.assert_allclose(found.degree[[0, 1]], 1.0, rtol=1e-12)
    np.testing.assert_allclose(found.degree[DP], 0.0 if H is VELOCITY else 1 / np.sqrt(2), atol=1e-9)
    assert (found.degree[[PHI_U, 7, 8, 9]] < 1e-11).all()
    assert found.share[PHI_U] < 1e-8


def test_ranks():
    still, turned = Segment(paper_F(), ALL, 60.0), Segment(paper_F(np.pi / 2), ALL, 60.0)

    def rank(Q):
        found = analyse(Q, 1e-8).rank
        assert found == np.linalg.matrix_rank(Q, tol=1e-8)
        return found

    assert rank(derivatives(Segment(paper_F(), VELOCITY, 60.0))) == 7
    assert rank(derivatives(Segment(paper_F(), BOTH, 60.0))) == 9
    assert rank(derivatives(still)) == 10
    assert rank(stripped([still, turned])) == 12
    assert rank(total([still, turned])) == 12
    assert rank(stripped([still, still])) == 10
    with_heading = analyse(derivatives(still), 1e-8)
    np.testing.assert_allclose(with_heading.degree[[PHI_U, 12]], 1.0, rtol=1e-6)
    after = analyse(stripped([still, turned]), 1e-8)
    assert after.degree[9] < 1e-12  # only the upward accelerometer is left
    assert (np.delete(after.degree, 9) > 1).all()
    np.testing.assert_allclose(np.delete(after.share, 9), 1.0, atol=1e-9)
    assert after.share[9] < 1e-9


def test_total_is_the_null_space_of_what_is_measured():
    """A vector in the null space of the total matrix gives no measurement at any time, one outside does."""
    rng = np.random.default_rng(0)
    n = 5
    hidden = np.array([0, 0, 0, 1.0, -1.0])
    segments = []
    for _ in range(3):
        F, H = 0.3 * rng.normal(size=(n, n)), rng.normal(size=(1, n))
        F -= np.outer(F @ hidden, hidden) / 2  # constant
        H -= np.outer(H @ hidden, hidden) / 2  # and not measured
        segments.append(Segment(F, H, 2.0))
    Q = total(segments)
    found = analyse(Q, 1e-9)
    assert found.rank == 4
    np.testing.assert_allclose(found.share[3:], 0.5)  # each is seen only with the other
    np.testing.assert_allclose(Q @ hidden, 0.0, atol=1e-12)
    assert all(strippable(s, 1e-9) for s in segments)
    assert analyse(stripped(segments), 1e-9).rank == 4
    # rows against finite differences of the simulated measurement
    x = rng.normal(size=n)
    through = expm(segments[0].F * 2.0) @ x
    np.testing.assert_allclose(Q[n] @ x, segments[1].H[0] @ through)
    np.testing.assert_allclose(
        Q[n + 1] @ x,
        segments[1].H[0] @ (expm(segments[1].F * 1e-6) - expm(-segments[1].F * 1e-6)) @ through / 2e-6,
        rtol=1e-6,
    )


def test_stripping_has_its_condition():
    """A drifting, unmeasured state: what the first segment hides moves, and the stripped matrix says less."""
    F = np.array([[0.0, 0, 0], [0, 0, 1.0], [0, 0, 0]])
    first, second = Segment(F, np.array([[1.0, 0, 0]]), 2.0), Segment(0 * F, np.array([[0, 1.0, 0]]), 2.0)
    assert not strippable(first, 1e-9)
    assert strippable(second, 1e-9)
    np.testing.assert_allclose(total([first, second])[3], [0, 1, 2.0])
    np.testing.assert_allclose(stripped([first, second])[3], [0, 1, 0])


def test_units_are_a_change_of_variables():
    rng = np.random.default_rng(1)
    segment = Segment(rng.normal(size=(4, 4)), rng.normal(size=(2, 4)), 3.0)
    state, noise = rng.uniform(0.1, 10, 4), rng.uniform(0.1, 10, 2)
    scaled = in_units(segment, state, noise, 5.0)
    x = rng.normal(size=4)
    carried = state * (expm(scaled.F * scaled.duration_s) @ (x / state))
    np.testing.assert_allclose(carried, expm(segment.F * 3.0) @ x, rtol=1e-9)
    np.testing.assert_allclose(noise * (scaled.H @ (x / state)), segment.H @ x)
    assert analyse(derivatives(scaled), 1e-9).rank == 4


IMU = ImuModel(1e-4, 1e-3, 2e-4, 0.02)


@pytest.mark.ci
def test_continuous_is_the_rate_of_the_transition():
    model = ErrorModel(
        ImuModel(1e-4, 1e-3, 1e-4, 0.05, 1e-6, 1e-5, 1e-5, 1e-3, 300.0, 200.0, 1e-3, 1e-3),
        [markov("gust", 2, 1.5, 3.0), Block("barometer_bias", 1, 300.0)],
    )
    q = np.array([0.4, -0.3, 0.6, 0.2])
    q /= np.linalg.norm(q)
    v, lla = np.array([20.0, -7.0, 2.0]), np.array([0.7, 0.2, 900.0])
    f, omega = np.array([1.0, -2.0, -9.0]), np.array([0.1, -0.2, 0.3])
    F = continuous(model, q, v, lla, f, omega)
    T = 0.01
    C = Rotation.from_quat(q, scalar_first=True).as_matrix()
    Phi, FT = np.zeros((9, model.mixing)), np.zeros((9, model.mixing))
    transition(Phi, FT, model.driven, v, lla[0], lla[2], T * np.stack([C, C * omega, C * f]), T)
    np.testing.assert_allclose(expm(F * T)[:9, : model.mixing], Phi, atol=3e-6)
    np.testing.assert_allclose(F[:3, 9:12], C, atol=1e-12)
    np.testing.assert_allclose(np.diag(F)[model.slices["gust"]], -1 / 3)
    np.testing.assert_allclose(F[3:6, model.slices["accel_scale"]], -C * f, atol=1e-12)


def test_the_error_model_at_rest_is_the_published_one():
    """F of the house, its vertical channel left out, against the paper's: same singular values, same ranks."""
    model = ErrorModel(IMU)
    lla = np.array([LAT, 2.2, 0.0])
    g = gravity(LAT, 0.0)

    def level(heading):
        q = Rotation.from_euler("z", heading).as_quat(scalar_first=True)
        F = continuous(model, q, np.zeros(3), lla, np.array([0, 0, -g]), np.zeros(3))
        keep = [3, 4, 6, 7, 0, 1, 2, *range(12, 15), *range(9, 12)]
        return F[np.ix_(keep, keep)]

    np.testing.assert_allclose(level(0.0)[4:7, 4:7] @ [1, 2, 3], -np.cross(earth_rate_n(LAT), [1, 2, 3]))
    for H, rank in ((VELOCITY, 7), (BOTH, 9), (ALL, 10)):
        found = analyse(derivatives(Segment(level(0.0), H, 60.0)), 1e-8)
        assert found.rank == rank
        expected = analyse(derivatives(Segment(paper_F(), H, 60.0)), 1e-8).singular_values
        np.testing.assert_allclose(found.singular_values[:rank], expected[:rank], rtol=6e-3)
    assert analyse(stripped([Segment(level(a), ALL, 60.0) for a in (0.0, np.pi / 2)]), 1e-8).rank == 12


def test_flown_straight_then_turning():
    """GNSS alone: heading and level accelerometers show once the aircraft turns, and not before."""
    model = ErrorModel(IMU)
    truth = flight(120.0)
    edges = np.arange(0, 121, 10.0)
    middle = ((edges[:-1] + 5) * 200).astype(int)
    dt = np.diff(truth.t)[0]
    lla = np.column_stack([truth.lat, truth.lon, truth.h])
    H = np.zeros((6, 15))
    H[:3, 6:9] = H[3:, 3:6] = np.eye(3)
    noise = np.array([1.5, 1.5, 1.5, 0.1, 0.1, 0.1])
    prior = np.concatenate([[0.02, 0.02, 0.1], [0.5] * 3, [5.0] * 3, [2e-4] * 3, [0.05] * 3])
    f_b, omega_b = truth.dv[middle] / dt, truth.dtheta[middle] / dt
    moving = flown(model, edges, truth.q_nb[middle], truth.v_n[middle], lla[middle], f_b, omega_b,
                   [(H, noise)] * 12, prior, 5.0)  # fmt: skip
    still = np.zeros(12, dtype=int)
    level = Rotation.from_euler("z", 0.7).as_quat(scalar_first=True)
    straight = flown(model, edges, np.tile(level, (12, 1)), np.tile([20.0, 15.0, 0.0], (12, 1)), lla[still],
                     np.tile([0, 0, -9.81], (12, 1)), np.zeros((12, 3)), [(H, noise)] * 12, prior, 5.0)  # fmt: skip
    names = state_names(model)
    assert names[:3] == ["phi north", "phi east", "phi down"]
    assert names[9:13] == ["gyro_bias x", "gyro_bias y", "gyro_bias z", "accel_bias x"]
    heading = names.index("phi down")
    assert np.isinf(straight.seen_from()[heading])
    assert np.isinf(straight.seen_from()[12:14]).all()  # nor the level accelerometers
    assert moving.seen_from()[heading] <= 60
    assert (np.diff(moving.rank) >= 0).all()
    assert moving.rank[-1] > straight.rank[-1]
    text = str(moving)
    assert f"{moving.rank[-1]:.0f} after" in text
    assert len(text.splitlines()) == 17
    assert "never" in str(straight)
    # the growing triangle is the stack of all segments
    segments = []
    for k, f, w in zip(middle[:4], f_b[:4], omega_b[:4], strict=True):
        F = continuous(model, truth.q_nb[k], truth.v_n[k], lla[k], f, w)
        segments.append(in_units(Segment(F, H, 10.0), prior, noise, 5.0))
    whole = analyse(stripped(segments), 1.0)
    np.testing.assert_allclose(along(names, segments, 0.0).share[-1], whole.share, atol=1e-9)
    np.testing.assert_allclose(moving.share[3], whole.share, atol=1e-9)
    assert moving.rank[3] == whole.rank
