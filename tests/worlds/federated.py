"""Federated filters in the simulated world of `worlds.ins`."""

import dataclasses
import functools

import numpy as np

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.alignment import InitialState
from nav.detection import ChiSquare, Eraim, Glr, Reset, Sprt, exponential
from nav.federated import Federated
from nav.federation import Local
from nav.horizon import FusionHorizon
from nav.monitor import MonitoredAid
from nav.samples import Status
from worlds.ins import CONSUMER, DEG, FIELD_N, barometer, error, feed, flight, gnss, imu, magnetometer


def field(*_):
    return FIELD_N


def true_start(truth, sigma=(0.1 * DEG, 0.1, 1.0)):
    covariance = np.diag(np.repeat(sigma, 3) ** 2)
    return InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0], truth.q_nb[0], covariance)


def named(fixes, sensor):
    return [dataclasses.replace(f, sensor=sensor) for f in fixes]


@functools.cache
def world(duration=120, seed=2):
    truth = flight(duration)
    rng = np.random.default_rng(seed)
    increments, *_ = imu(truth, CONSUMER, rng)
    one, two = gnss(truth, rng, 5.0), named(gnss(truth, rng, 5.0), "gnss2")
    return truth, increments, one, two, barometer(truth, rng, 40.0, rate_hz=5.0) + magnetometer(truth, rng, rate_hz=5.0)


def three(detector=lambda: ChiSquare(1e-3)):
    return (
        Local("one", (MonitoredAid(GnssAid(), detector),)),
        Local("two", (MonitoredAid(GnssAid("gnss2"), detector),)),
        Local("air", (MonitoredAid(BarometerAid(), detector), MonitoredAid(MagnetometerAid(), detector))),
    )


def fly(config, samples, increments, seconds=1.0):
    federated = Federated(config, field)
    estimates, reports = feed(FusionHorizon(federated), increments, samples, seconds)
    return federated, estimates, reports


def horizontal(estimates, truth, after=0.0):
    return {
        round(e.t, 3): float(np.hypot(*error(e, truth)[:2]))
        for e in estimates
        if e.t > after and e.status & Status.ALIGNED
    }


def differ(a, b, truth):
    """Largest difference of two estimates in sigmas of the second, and of the sigmas themselves."""
    sigma = np.sqrt(np.diag(b.covariance))
    shift = np.abs(error(a, truth) - error(b, truth)) / sigma
    return shift.max(), np.abs(np.sqrt(np.diag(a.covariance)) / sigma - 1).max()


def ramp(fixes, start, stop, slope, with_velocity):
    """Spoofed northwards: the position runs away, and the velocity with it or not."""
    spoofed = []
    for fix in fixes:
        if start <= fix.t < stop:
            v_n = fix.v_n + np.array([slope * with_velocity, 0.0, 0.0])
            fix = dataclasses.replace(fix, lat=fix.lat + slope * (fix.t - start) / 6.37e6, v_n=v_n)
        spoofed.append(fix)
    return spoofed


DETECTORS = {
    "chi_square": lambda: ChiSquare(1e-3),
    "eraim": lambda: Eraim(1e-3),
    "sprt": lambda: Sprt(1e-6, exponential(0.95), Reset.COMPLETE),
    "glr": lambda: Glr(1e-6),
}
