"""A record as RTKLIB's solution files: one for truth, one for each receiver and estimator.

Quality is 1 (fix) of truth, 5 (single) of the others. Times are GPS time. Source: RTKLIB ver. 2.4.2 Manual,
Appendix B.1.
"""

from __future__ import annotations

import datetime as dt
from typing import TYPE_CHECKING

import numpy as np

from testbed.exports.track import TRUTH, Track, tracks
from testbed.exports.view import View
from testbed.sensors.gnss import LEAP_S

if TYPE_CHECKING:
    import xarray

FIX, SINGLE = 1, 5
HEAD = """% program   : navigation-testbed
% inp file  : {title}: {name}
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio
"""  # noqa: E501


def contents(tree: xarray.DataTree) -> dict[str, bytes]:
    """The files of a record by their names."""
    view = View(tree)
    return {f"{track.name}.pos": _file(view, track).encode() for track in tracks(view, receivers=True)}


def _file(view: View, track: Track) -> str:
    lines = [HEAD.format(title=view.title, name=track.name)]
    quality = FIX if track.name == TRUTH else SINGLE
    # Down to up: of its products with the others the sign.
    covariance = np.nan_to_num(track.covariance) * np.array([[1, 1, -1], [1, 1, -1], [-1, -1, 1]])
    root = np.sign(covariance) * np.sqrt(np.abs(covariance))
    for k, t in enumerate(track.t):
        when = view.midnight + dt.timedelta(seconds=LEAP_S, milliseconds=round(float(t) * 1e3))
        n, e, u = root[k]
        sigmas = (n[0], e[1], u[2], n[1], e[2], u[0])
        lines.append(
            f"{when:%Y/%m/%d %H:%M:%S}.{when.microsecond // 1000:03d} {np.degrees(track.lat[k]):14.9f} "
            f"{np.degrees(track.lon[k]):14.9f} {track.h[k]:10.4f} {quality:3d} {0:3d} "
            + " ".join(f"{sigma:8.4f}" for sigma in sigmas)
            + "   0.00    0.0\n"
        )
    return "".join(lines)
