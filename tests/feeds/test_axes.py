"""Gyros, accelerometers and magnetometers of a log whose axes are not the same are told, and no others."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nav.samples import FixType, GnssSample, ImuSamples, MagnetometerSample
from testbed.feeds import axes
from testbed.feeds.axes import unlike
from testbed.feeds.log import Log

LASTS, STEP, GRAVITY = 200.0, 0.02, 9.80665
FIELD_N, IRON = np.array([21e-6, 1e-6, 43e-6]), np.array([6e-6, -3e-6, 4e-6])
NONE = (("x", "y", "z"), ("x", "y", "z"), ("x", "y", "z"))


def of(names):
    """The rows of these axes, as a table's columns name them."""
    rows = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
    return np.array([np.multiply(-1.0 if "-" in name else 1.0, rows[name[-1]]) for name in names])


def flown(gyros=NONE[0], accelerometers=NONE[1], fields=NONE[2], swings=0.5, lasts=LASTS, receiver=True):
    """A vehicle that turns about all axes and is pushed about; what its sensors say is in these axes of it."""
    rng = np.random.default_rng(11)
    t = np.arange(0.0, lasts, STEP)
    angles = swings * np.column_stack([np.sin(0.41 * t), 0.7 * np.sin(0.29 * t + 1), 2.5 * np.sin(0.17 * t)])
    q_nb = Rotation.from_euler("ZYX", angles[:, ::-1])
    dtheta = (q_nb[:-1].inv() * q_nb[1:]).as_rotvec() + rng.normal(0.0, 1e-4, (len(t) - 1, 3))
    v_n = np.column_stack([8 * np.sin(0.3 * t), 6 * np.cos(0.23 * t), np.sin(0.5 * t)])
    push_n = np.diff(v_n, axis=0) - np.array([0.0, 0.0, GRAVITY * STEP])
    middle = q_nb[:-1] * Rotation.from_rotvec(0.5 * dtheta)
    dv = middle.inv().apply(push_n) + rng.normal(0.0, 0.01, (len(t) - 1, 3))
    imu = ImuSamples(t[1:], np.full(len(t) - 1, STEP), dtheta @ of(gyros).T, dv @ of(accelerometers).T)
    field_b = (q_nb.inv().apply(FIELD_N) + rng.normal(0.0, 2e-7, (len(t), 3)) + IRON) @ of(fields).T
    sigma = np.ones(3)
    samples = {"magnetometer": [MagnetometerSample(t[k], t[k], field_b[k]) for k in range(0, len(t), 5)]}
    if receiver:
        samples["gnss"] = [
            GnssSample(
                t[k], t[k], 0.8, 0.1, 0.0, v_n[k] + rng.normal(0.0, 0.1, 3), sigma, sigma, FixType.FIX_3D, 9, 1.0, 1.0
            )
            for k in range(0, len(t), 10)
        ]
    return Log(Path("a.npz"), "table", {"imu": imu}, samples, None, 0.0, {})


def test_there_are_48_axes_and_the_first_are_those_it_has():
    all_of_them = np.array([sign * M for sign in axes.SIGNS for M in axes.PROPER])
    assert len({tuple(one.ravel()) for one in all_of_them}) == 48
    assert np.allclose(np.abs(np.linalg.det(all_of_them)), 1.0)
    assert (all_of_them[0] == np.eye(3)).all()


@pytest.mark.parametrize("receiver", [True, False])
def test_nothing_is_said_of_what_is_right(receiver):
    assert unlike(flown(receiver=receiver)) == {}


GYROS = [
    ("x", "-y", "-z"), ("y", "x", "-z"), ("-x", "-y", "-z"), ("x", "y", "-z"), ("z", "x", "y"), ("y", "-x", "z"),
    ("x", "z", "y"),
]  # fmt: skip


def back(names):
    """The axes, of what is turned into these, that make it right again."""
    return [("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in of(names).T]


def quoted(names):
    return "[" + ", ".join(f'"{one}"' for one in names) + "] of what it is taken for)"


@pytest.mark.parametrize("wrong", GYROS)
def test_gyros_in_other_axes(wrong):
    told = unlike(flown(gyros=wrong))
    assert list(told) == ["imu"]  # though the field turns otherwise, too
    said = "imu: its accelerometers feel other turns than its gyros: correct the axes of its gyros (by its turns "
    assert told["imu"] == said + quoted(back(wrong))


@pytest.mark.parametrize("wrong", [("x", "-y", "-z"), ("y", "-x", "z"), ("z", "x", "y")])
def test_accelerometers_in_other_axes(wrong):
    told = unlike(flown(accelerometers=wrong))
    assert list(told) == ["imu"]
    assert "correct the axes of its accelerometers" in told["imu"]
    assert told["imu"].endswith(quoted(back(wrong)))


@pytest.mark.parametrize("wrong", [("-x", "-y", "z"), ("y", "-x", "z"), ("-y", "-x", "-z")])
def test_a_magnetometer_in_other_axes(wrong):
    told = unlike(flown(fields=wrong))
    assert list(told) == ["magnetometer"]
    said = "magnetometer: its field turns otherwise than the gyros of imu say: leave it out of the estimators' aids, or"
    assert told["magnetometer"].startswith(said + " correct its axes (by its turns ")
    assert told["magnetometer"].endswith(quoted(back(wrong)))


def test_one_sign_of_a_field_is_as_good_as_the_two_others():
    told = unlike(flown(fields=("x", "y", "-z")))
    assert told["magnetometer"].endswith(quoted(["-x", "-y", "z"]))


def test_without_a_field_either_may_be_wrong():
    log = flown(gyros=("x", "-y", "-z"))
    told = unlike(replace(log, samples={"gnss": log.samples["gnss"]}))
    assert told["imu"].endswith(quoted(["x", "-y", "-z"]) + ", or of its accelerometers")


def test_without_a_receiver_gravity_tells():
    assert unlike(flown(gyros=("x", "-y", "-z"), receiver=False))["imu"].endswith(quoted(["x", "-y", "-z"]))


@pytest.mark.parametrize("what", [{"swings": 0.02}, {"lasts": 60.0}])
def test_too_little_says_nothing(what):
    assert unlike(flown(gyros=("x", "-y", "-z"), **what)).get("imu") is None


def test_what_no_axes_make_right_is_not_told_of_axes():
    log = flown()
    imu = log.imus["imu"]
    noise = np.random.default_rng(3).normal(0.0, 0.02, imu.dtheta.shape)
    assert unlike(replace(log, imus={"imu": replace(imu, dtheta=noise)})) == {}


def test_gaps_and_what_is_not_known_are_left_out():
    log = flown(gyros=("x", "-y", "-z"))
    imu = log.imus["imu"]
    dtheta, rows = imu.dtheta.copy(), (imu.t < 40) | (imu.t > 55)
    dtheta[(imu.t > 80) & (imu.t < 90)] = math.nan
    holed = ImuSamples(imu.t[rows], imu.dt[rows], dtheta[rows], imu.dv[rows])
    assert unlike(replace(log, imus={"imu": holed}))["imu"].endswith(quoted(["x", "-y", "-z"]))
