"""A magnetometer of three axes: the geomagnetic field in body axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import inlined, lean, njit
from nav.aids.base import Kind, Measurement, OperatingPoint, range_problem
from nav.claims import Following
from nav.columns import column
from nav.error_model import PHI, Block, markov
from nav.rotation import Three, dcm_components
from nav.samples import Array, MagnetometerSample, Sample

FIELD_SIZE = 5e-5  # of the geomagnetic field at middle latitudes [T]
LEAST = 1 / 4  # of the variance that is told: currents come and go within minutes
FIELD_LIMITS = (5e-6, 200e-6)  # magnitude that a sound sample may have; the Earth's is 22 to 67 uT [T]


@dataclass(frozen=True)
class MagnetometerAid:
    """Three axes; without a reference field it is not used.

    A current beside it bends the field and makes it longer or shorter: by as much of that as the ``doubt`` says each
    axis is doubted, whatever the attitude. With ``follow_s`` noise and doubt are claimed to be less as long as they are
    (`nav.claims`).
    """

    sensor: str = "magnetometer"
    sigma: float = 0.5e-6  # [T]
    bias_sigma: float = 1.0e-6  # hard iron left after calibration [T]
    anomaly_sigma: float = 0.0  # of the reference field, constant in n [T]
    error_sigma: float = 0.0  # what changes with attitude, as a Markov process [T]
    error_correlation_s: float = 30.0
    soft_iron_sigma: float = 0.0  # of each element of the matrix that soft iron left after calibration is [1]
    doubt: float = 0.0  # of what the field's length is off by, the share that each axis may be, beside the noise
    follow_s: float = 0.0  # over which what is claimed of both follows innovations, 0: it does not [s]

    parts = (("magnetometer", 3),)

    @property
    def following(self) -> dict[str, Following]:
        """See `nav.claims.FollowingAid`."""
        return {"magnetometer": Following(self.follow_s, LEAST)} if self.follow_s else {}

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return tuple(f"{self.sensor}_{name}" for name in ("bias", "anomaly", "error", "soft_iron"))

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        bias, anomaly, error, soft_iron = self.states
        return [
            Block(bias, 3, self.bias_sigma),
            Block(anomaly, 3, self.anomaly_sigma),
            markov(error, 3, self.error_sigma, self.error_correlation_s),
            Block(soft_iron, 9, self.soft_iron_sigma),
        ]

    @property
    def bend(self) -> float:
        """By what the field is bent per axis beside the bias, 1 sigma [T]."""
        return math.hypot(self.anomaly_sigma, self.error_sigma, self.soft_iron_sigma * FIELD_SIZE)

    @cached_property
    def _R(self) -> Array:
        return np.full(3, self.sigma**2)

    @property
    def plain(self) -> tuple[Kind, tuple[float, ...]] | None:
        """See `PlainAid`: its variances."""
        return None if self.doubt else (Kind.MAGNETOMETER, tuple(self._R.tolist()))

    def numbers(self, samples: Sequence[MagnetometerSample]) -> Array:
        """See `PlainAid`."""
        return column(samples, "field_b")

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, MagnetometerSample)
        state, (bias, anomaly, error, soft_iron) = at.state, at.starts
        if not at.reference.has_field:
            return None
        field_n = at.reference.field_n(state.lla)
        nu, H = magnetometer(state.q_nb, at.x, bias, error, anomaly, soft_iron, field_n, sample.field_b)
        if not self.doubt:
            return Measurement(nu, H, self._R)
        rest = sample.field_b - (at.x[bias : bias + 3] if bias >= 0 else 0.0)
        length = math.hypot(*rest.tolist()) - math.hypot(*field_n.tolist())
        return Measurement(nu, H, self._R + (self.doubt * length) ** 2)


def problem(sample: MagnetometerSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("field", math.hypot(*sample.field_b.tolist()), FIELD_LIMITS)


@njit
def magnetometer(
    q_nb: Array, x: Array, bias: int, error: int, anomaly: int, soft_iron: int, field_n: Array, field_b: Array
) -> tuple[Array, Array]:
    """Magnetic field [T] in body axes: (I + A) C_nb' (field_n + anomaly) + bias + error, ``field_n`` the reference
    field there.

    ``bias``, ``error`` and the matrix A of soft iron, row by row, are fixed to the body, ``anomaly`` to n; each is
    where its states begin, -1 for none.
    """
    nu, H = np.empty(3), np.zeros((3, len(x)))
    put_magnetometer(nu, H, q_nb, x, bias, error, anomaly, soft_iron, field_n, field_b)
    return nu, H


@lean
def put_magnetometer(
    nu: Array, H: Array, q_nb: Array, x: Array, bias: int, error: int, anomaly: int, soft_iron: int, field_n: Array,
    field_b: Array,
) -> None:  # fmt: skip
    """`magnetometer` into ``nu`` (3,) and zeros ``H`` (3, n)."""
    C_nb = dcm_components(q_nb)
    m0, m1, m2 = field_n[0], field_n[1], field_n[2]
    if anomaly >= 0:
        m0, m1, m2 = m0 + x[anomaly], m1 + x[anomaly + 1], m2 + x[anomaly + 2]
    for i in range(3):
        c0, c1, c2 = C_nb[0][i], C_nb[1][i], C_nb[2][i]
        nu[i] = field_b[i] - (c0 * m0 + c1 * m1 + c2 * m2)
        # -C_nb' [field x]
        H[i, PHI] = c2 * m1 - c1 * m2
        H[i, PHI + 1] = c0 * m2 - c2 * m0
        H[i, PHI + 2] = c1 * m0 - c0 * m1
        if anomaly >= 0:
            H[i, anomaly], H[i, anomaly + 1], H[i, anomaly + 2] = c0, c1, c2
        for start in (bias, error):
            if start >= 0:
                H[i, start + i] = 1.0
                nu[i] -= x[start + i]
    if soft_iron >= 0:
        _soften(nu, H, C_nb, x, anomaly, soft_iron, m0, m1, m2)


@inlined
def _soften(
    nu: Array, H: Array, C_nb: tuple[Three, Three, Three], x: Array, anomaly: int, soft_iron: int, m0: float, m1: float,
    m2: float,
) -> None:  # fmt: skip
    """Add soft iron to the innovation (3,) and the Jacobian (3, n) of a magnetometer in the field m (3,) of n."""
    turned = (
        (H[0, PHI], H[0, PHI + 1], H[0, PHI + 2]),
        (H[1, PHI], H[1, PHI + 1], H[1, PHI + 2]),
        (H[2, PHI], H[2, PHI + 1], H[2, PHI + 2]),
    )
    for i in range(3):
        for j in range(3):
            a, m_b = x[soft_iron + 3 * i + j], C_nb[0][j] * m0 + C_nb[1][j] * m1 + C_nb[2][j] * m2
            H[i, soft_iron + 3 * i + j] = m_b
            nu[i] -= a * m_b
            for k in range(3):
                H[i, PHI + k] += a * turned[j][k]
                if anomaly >= 0:
                    H[i, anomaly + k] += a * C_nb[k][j]
