"""What goes onto a map: where truth, receivers and estimators were and when, and how sure they were of it."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nav.earth import radii
from nav.samples import Array
from testbed.exports.view import Columns, View, fixed, placed

CONFIDENT = 5.991  # chi-square of two degrees of freedom at 95 %
CORNERS = 36  # of an ellipse
ELLIPSE_EVERY_S = 30.0
TRUTH = "truth"


@dataclass(frozen=True, slots=True)
class Track:
    """One line on the map: times (N,) [s], latitude, longitude [rad], height [m] (N,).

    ``covariance`` (N, 3, 3) [m^2] NED is what it claims of its position, NaN where it claims nothing; ``estimated``
    says whether an estimator wrote it.
    """

    name: str
    t: Array
    lat: Array
    lon: Array
    h: Array
    covariance: Array
    estimated: bool = False


def tracks(view: View, receivers: bool = False) -> list[Track]:
    """Truth, then receivers where they are asked for, then estimators that know a position."""
    found = [_track(TRUTH, view.truth, np.full((len(view.truth["time"]), 3, 3), np.nan))]
    if receivers:
        for name, own in view.sensors["gnss"].items():
            fix = fixed(own)
            having = {key: values[fix] for key, values in own.items()}
            variances = having["sigma_position_n"] ** 2
            found.append(_track(name, having, variances[:, :, None] * np.eye(3)))
    for name, own in view.estimators.items():
        found.append(_track(name, own, own["covariance"][:, :3, :3].astype(float), estimated=True))
    return [one for one in found if len(one.t)]


def _track(name: str, own: Columns, covariance: Array, estimated: bool = False) -> Track:
    known = placed(own)
    t, lat, lon, h = (np.asarray(own[key][known], float) for key in ("time", "lat", "lon", "h"))
    return Track(name, t, lat, lon, h, covariance[known], estimated)


def ellipse(covariance: Array) -> tuple[Array, Array, Array]:
    """Half axes, larger first [m], and azimuth of the larger [rad] of the 95 % ellipses of covariances (N, 3, 3)."""
    horizontal = np.nan_to_num(covariance[:, :2, :2])
    values, vectors = np.linalg.eigh(horizontal)
    half = np.sqrt(np.maximum(values, 0.0) * CONFIDENT)
    return half[:, 1], half[:, 0], np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


def outlines(track: Track) -> Iterator[tuple[float, Array]]:
    """The 95 % ellipses of a track every half minute: time and corners (n, 3), latitude, longitude [rad], height."""
    due = np.unique(np.searchsorted(track.t, np.arange(track.t[0], track.t[-1], ELLIPSE_EVERY_S)))
    angle = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
    for k in due:
        if not np.isfinite(track.covariance[k]).all():
            continue
        (a,), (b,), (azimuth,) = ellipse(track.covariance[k][None])
        along, across = a * np.cos(angle), b * np.sin(angle)
        north = along * np.cos(azimuth) - across * np.sin(azimuth)
        east = along * np.sin(azimuth) + across * np.cos(azimuth)
        lat, h = float(track.lat[k]), float(track.h[k])
        R_M, R_N = radii(lat)
        corners = [lat + north / (R_M + h), track.lon[k] + east / ((R_N + h) * np.cos(lat)), np.full(len(angle), h)]
        yield float(track.t[k]), np.column_stack(corners)


def utc(view: View, t: float) -> str:
    """A time of the run as ISO 8601 has it, to the millisecond."""
    when = view.midnight + dt.timedelta(milliseconds=round(t * 1e3))
    return when.strftime("%Y-%m-%dT%H:%M:%S.") + f"{when.microsecond // 1000:03d}Z"
