"""Where over a map a row of measured ground heights fits: a point-mass filter of the horizontal position.

A grid of places moves with the dead-reckoned velocity. Each carries the likelihood of all heights measured since it was
laid, `PointMass.begin`, whatever was known before; it is widened as the velocity is uncertain and weighed by each
measurement (Bergman, Ljung and Gustafsson, Terrain Navigation Using Bayesian Statistics, IEEE Control Systems 19 (3),
1999). What a height is wrong by, a constant and a Markov error of the map, is linear once the place is given: each
place has its own estimate of both by a Kalman filter, with one covariance for all (marginalised: Nordlund and
Gustafsson, Marginalized Particle Filter for Accurate and Reliable Terrain-Aided Navigation, IEEE Trans. Aerospace and
Electronic Systems 45 (4), 2009).

The likelihood has many peaks at first. Times the filter's own position it is a posterior, and once that looks like a
Gaussian, `PointMass.fix` is the measurement that leads there from the filter's own: mean m and covariance C of the
posterior, position x and P of the filter, give R^-1 = C^-1 - P^-1 and z = x + R C^-1 (m - x). So what the filter knew
is in no fix, and nothing that was measured is in two of them, for the grid is laid anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from nav._jit import njit
from nav.earth import radii, wrap_longitude
from nav.samples import Array
from nav.terrain import Terrain, ground

POINTS = 81  # along each side of the grid
SPREAD = 4.0  # sigma from the middle of the grid to its edge
FINEST = 5.0  # between points [m]
# Mardia's kurtosis of what passes for a Gaussian in a plane, which has 8; two equal peaks 6, unequal ones more.
GAUSSIAN = (7.0, 9.5)
ON_EDGE = 1e-3  # of the posterior, at the most
UNLIKELY = 1e-4  # that heights fit no better where they fit best, so that they are not of this ground


class Fix(NamedTuple):
    """A place, ``lat``, ``lon`` [rad], and the covariance (2, 2) north, east of what is measured of it [m^2]."""

    lat: float
    lon: float
    R: Array


class PointMass:
    """The likelihood of places over a ``terrain``, from heights of the ground with white noise ``sigma`` [m].

    The map errs by ``local_sigma`` [m] (Markov, ``local_correlation_s``) beside one height everywhere.
    """

    def __init__(self, terrain: Terrain, sigma: float, local_sigma: float, local_correlation_s: float) -> None:
        self.terrain, self.sigma = terrain, sigma
        self.local_sigma, self.local_correlation_s = local_sigma, local_correlation_s

    def begin(self, t: float, lla: Array, P: Array, sigma_h: float) -> None:
        """Lay the grid at ``t`` [s] around a place (3,) known to ``P`` (2, 2) [m^2], nothing being measured yet.

        ``sigma_h`` [m] is of height over the map.
        """
        self.t = self.t_begun = t
        self.lat, self.lon, self.h = lla
        self.drift = np.zeros(2)  # variance of the way since then, horizontally per axis and up [m^2]
        half = 0.5 * (POINTS - 1)
        self.step = np.maximum(SPREAD * np.sqrt(P.diagonal()) / half, FINEST)
        self.axis = np.arange(POINTS) - half
        self.log_w = np.zeros((POINTS, POINTS))
        self.level, self.weighed = 0.0, 0  # log likelihood of weight one, and of how many measurements
        self.errors = np.zeros((2, POINTS, POINTS))  # of the height: constant, local
        self.C = np.diag([sigma_h**2, self.local_sigma**2])  # of these

    def move(self, t: float, v_n: Array, sigma_v: Array) -> None:
        """Go on to ``t`` [s] at the velocity ``v_n`` (3,), known to ``sigma_v`` (2,) horizontally, per axis, and up.

        The way is as wrong as if that had been the velocity's error all the time.
        """
        dt = t - self.t
        more = np.maximum((sigma_v * (t - self.t_begun)) ** 2 - self.drift, 0.0)
        self.drift += more
        R_M, R_N = radii(self.lat)
        self.lat += v_n[0] * dt / R_M
        self.lon += v_n[1] * dt / (R_N * math.cos(self.lat))
        self.h -= v_n[2] * dt
        phi = math.exp(-dt / self.local_correlation_s)
        self.errors[1] *= phi
        self.C *= np.array([[1.0, phi], [phi, phi * phi]])
        self.C += np.diag([more[1], self.local_sigma**2 * (1 - phi * phi)])
        self.level += float(self.log_w.max())
        _widen(self.log_w, self.errors, more[0] / self.step**2)
        self.t = t

    def weigh(self, sight_n: Array) -> None:
        """Use a measured line of sight (3,) [m], north, east, down, from the vehicle to the ground.

        How the ground differs from a place of the grid to the next is noise, too, as the vehicle is somewhere between.
        """
        map_ = _heights(self.lat, self.lon, self.step, sight_n, self.terrain.heights, self.terrain.grid)
        between = (np.mean(np.diff(map_, axis=0) ** 2) + np.mean(np.diff(map_, axis=1) ** 2)) / 12.0
        S = float(self.C.sum() + self.sigma**2 + between)
        K = self.C.sum(axis=1) / S
        nu = self.h - sight_n[2] - map_ - self.errors.sum(axis=0)
        self.log_w -= 0.5 * nu**2 / S
        self.weighed += 1
        self.errors += K[:, None, None] * nu
        self.C -= np.outer(K, K) * S

    def posterior(self, lat: float, lon: float, P: Array) -> tuple[Array, Array, float, float]:
        """With a filter's own place [rad] and covariance ``P`` (2, 2) [m^2]: mean (2,) from there and covariance [m^2],
        Mardia's kurtosis, and the share that lies on the edge of the grid.
        """
        R_M, R_N = radii(self.lat)
        off = np.array([(self.lat - lat) * R_M, wrap_longitude(self.lon - lon) * R_N * math.cos(self.lat)])
        north, east = (off[i] + self.axis * self.step[i] for i in range(2))
        places = np.stack(np.meshgrid(north, east, indexing="ij"), axis=-1)
        log_w = self.log_w - 0.5 * np.einsum("ijk,kl,ijl->ij", places, np.linalg.inv(P), places)
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
        mean = np.einsum("ij,ijk->k", w, places)
        away = places - mean
        C = np.einsum("ij,ijk,ijl->kl", w, away, away) + np.diag(self.step**2) / 12.0
        d2 = np.einsum("ijk,kl,ijl->ij", away, np.linalg.inv(C), away)
        return mean, C, float(np.sum(w * d2 * d2)), float(1.0 - w[1:-1, 1:-1].sum())

    @property
    def fits(self) -> bool:
        """Whether there is a place where the heights fit: their squared normalised innovations there, by chi-square.

        A broken sensor, or a map of elsewhere, has its most likely place as well.
        """
        misfit = -2.0 * (self.level + float(self.log_w.max()))
        return bool(misfit <= chdtri(max(self.weighed, 1), UNLIKELY))

    def fix(self, lat: float, lon: float, P: Array) -> Fix | None:
        """What was measured of the place, None while it is not one place, or hardly better known than before."""
        mean, C, kurtosis, on_edge = self.posterior(lat, lon, P)
        if not GAUSSIAN[0] <= kurtosis <= GAUSSIAN[1] or on_edge > ON_EDGE or C.trace() > 0.5 * P.trace():
            return None
        information = np.linalg.inv(C) - np.linalg.inv(P)
        if np.linalg.eigvalsh(information)[0] <= 0.0:
            return None
        R = np.linalg.inv(information)
        z = R @ np.linalg.solve(C, mean)
        R_M, R_N = radii(lat)
        return Fix(lat + z[0] / R_M, wrap_longitude(lon + z[1] / (R_N * math.cos(lat))), R)


@njit
def _widen(log_w: Array, errors: Array, variance: Array) -> None:
    """Let the places spread by ``variance`` (2,) [steps^2], to the next ones along each axis, in place."""
    n = len(log_w)
    w = np.exp(log_w - log_w.max())
    moments = np.empty((3, n, n))
    moments[0] = w
    moments[1], moments[2] = w * errors[0], w * errors[1]
    for axis in range(2):
        a = min(0.5 * variance[axis], 0.25)
        before = moments.copy()
        for k in range(3):
            for i in range(n):
                for j in range(n):
                    lower = before[k, max(i - 1, 0), j] if axis == 0 else before[k, i, max(j - 1, 0)]
                    upper = before[k, min(i + 1, n - 1), j] if axis == 0 else before[k, i, min(j + 1, n - 1)]
                    moments[k, i, j] = (1 - 2 * a) * before[k, i, j] + a * (lower + upper)
    for i in range(n):
        for j in range(n):
            total = moments[0, i, j]
            log_w[i, j] = math.log(max(total, 1e-300))
            if total > 1e-290:
                errors[0, i, j], errors[1, i, j] = moments[1, i, j] / total, moments[2, i, j] / total


@njit
def _heights(lat: float, lon: float, step: Array, sight_n: Array, heights: Array, grid: Array) -> Array:
    """The map at the places of the grid, as far ahead of each as is looked."""
    R_M, R_N = radii(lat)
    cos_lat = math.cos(lat)
    found = np.empty((POINTS, POINTS))
    for i in range(POINTS):
        row = lat + ((i - 0.5 * (POINTS - 1)) * step[0] + sight_n[0]) / R_M
        for j in range(POINTS):
            column = lon + ((j - 0.5 * (POINTS - 1)) * step[1] + sight_n[1]) / (R_N * cos_lat)
            found[i, j] = ground(row, column, heights, grid)[0]
    return found
