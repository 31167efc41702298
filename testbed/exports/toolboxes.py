"""A record as the inputs of two MATLAB toolboxes for inertial navigation, with truth to compare with.

* ``navego``: structs ``imu`` (t, fb, wb), ``gnss`` (t, lat, lon, h, vel, stdm, stdv, larm) and ``ref`` (t, roll, pitch,
  yaw, lat, lon, h, vel), SI and radians, NED. Sources: headers of ins_gnss.m and gnss_gen.m of NaveGo 1.4.
* ``psins``: struct ``trj`` with ``imu`` [wm vm t], ``avp`` [att vn pos t], ``avp0`` and ``ts``, and ``gps`` [vn pos t],
  body axes right-forward-up, navigation axes east-north-up, att pitch, roll and yaw, which counts from north to west.
  Sources: trjfile.m, avpset.m and insupdate.m of PSINS.

Of truth there are the rows that have an attitude. Where none has any, ``ref`` is without angles, and ``trj`` without
``avp`` and ``avp0``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.errors import UserError
from testbed.exports.matlab import packed
from testbed.exports.view import Columns, View, fixed, only, turned
from testbed.score.accuracy import euler
from testbed.sensors.gnss import GnssConfig

if TYPE_CHECKING:
    import xarray


def content(tree: xarray.DataTree, version: str) -> bytes:
    """The file of a record for a toolbox. Raises UserError where there are no inertial samples."""
    view = View(tree)
    imu = view.first("imu")
    if imu is None:
        raise UserError("the record has no inertial samples: run it with record.imu = true")
    return packed((_navego if version == "navego" else _psins)(view, imu))


def _fixes(view: View) -> Columns:
    """The samples of the first receiver with a fix, none without a receiver."""
    own = view.first("gnss")
    return {} if own is None else only(own, fixed(own))


def _hz(t: Array) -> float:
    return float(1 / np.median(np.diff(t))) if len(t) > 1 else 0.0


def _navego(view: View, imu: Columns) -> dict[str, Any]:
    dt, upright = imu["dt"][:, None], turned(view.truth)
    truth = only(view.truth, upright) if upright.any() else view.truth
    angles = dict(zip(("roll", "pitch", "yaw"), euler(truth["q_nb"]).T, strict=True)) if upright.any() else {}
    root: dict[str, Any] = {
        "imu": {"t": imu["time"], "fb": imu["dv"] / dt, "wb": imu["dtheta"] / dt, "freq": _hz(imu["time"])},
        "ref": {
            "t": truth["time"],
            **angles,
            **{name: truth[name] for name in ("lat", "lon", "h")},
            "vel": truth["v_n"],
            "freq": _hz(truth["time"]),
        },
    }
    if gnss := _fixes(view):
        section = view.scenario.sensors.get(next(iter(view.sensors["gnss"])))
        arm = section.lever_arm_m if isinstance(section, GnssConfig) else (0.0, 0.0, 0.0)
        root["gnss"] = {
            "t": gnss["time"],
            **{name: gnss[name] for name in ("lat", "lon", "h")},
            "vel": gnss["v_n"],
            "stdm": np.median(gnss["sigma_position_n"], axis=0)[None],
            "stdv": np.median(gnss["sigma_velocity_n"], axis=0)[None],
            "larm": np.array(arm, float)[:, None],
            "freq": _hz(gnss["time"]),
        }
    return root


def _psins(view: View, imu: Columns) -> dict[str, Any]:
    truth = only(view.truth, turned(view.truth))
    roll, pitch, heading = euler(truth["q_nb"]).T
    att = np.column_stack([pitch, roll, -heading])
    avp = np.column_stack([att, _enu(truth["v_n"]), truth["lat"], truth["lon"], truth["h"], truth["time"]])
    increments = np.column_stack([_enu(imu["dtheta"]), _enu(imu["dv"]), imu["time"]])
    own = {"imu": increments, "ts": float(np.median(imu["dt"]))}
    root: dict[str, Any] = {"trj": own | ({"avp": avp, "avp0": avp[0, :9, None]} if len(avp) else {})}
    if gnss := _fixes(view):
        root["gps"] = np.column_stack([_enu(gnss["v_n"]), gnss["lat"], gnss["lon"], gnss["h"], gnss["time"]])
    return root


def _enu(ned: Array) -> Array:
    """East, north, up of north, east, down, and right, forward, up of forward, right, down (N, 3)."""
    return np.asarray(ned[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]))
