"""Places and velocities of a table along the axes of the Earth (ECEF), as those of an ellipsoid: north, east, down.

Both as `nav.earth` turns them (Groves 2.112, 2.150; Bowring).
"""

from __future__ import annotations

import numpy as np

from nav.earth import A, dcm_en, geodetic_from_ecef
from nav.samples import Array
from testbed.errors import UserError
from testbed.motion.logged import Stream

FAR_M = 1e6  # from the ellipsoid: no vehicle is, and a place of another unit is


def on_the_ellipsoid(where: str, stream: Stream, values: dict[str, Array]) -> dict[str, Array]:
    """Quantities [SI] with ``lat``, ``lon``, ``height`` (N,) in place of a ``position`` (N, 3) from the Earth's centre.

    A velocity (N, 3) whose frame is ``ecef`` is north, east, down then. A place of zeros stays one: 0 N 0 E. Raises
    UserError when most places are no vehicle's, and when there is no place to turn a velocity at.
    """
    values = dict(values)
    if (position := values.pop("position", None)) is not None:
        if beside := sorted({"lat", "lon", "height"} & values.keys()):
            raise UserError(f"{where}.{beside[0]}: is given beside position: say one of them only")
        _require_near(where, position)
        lla = np.array([geodetic_from_ecef(r) if r.any() else np.zeros(3) for r in position]).reshape(-1, 3)
        values |= dict(zip(("lat", "lon", "height"), lla.T, strict=True))
    if stream.velocity is not None and stream.velocity.frame == "ecef":
        if not {"lat", "lon"} <= values.keys():
            raise UserError(f'{where}.velocity: frame = "ecef" needs a position, or lat and lon, to be turned at')
        turned = zip(values["velocity"], values["lat"], values["lon"], strict=True)
        values["velocity"] = np.array([v @ dcm_en(lat, lon) for v, lat, lon in turned]).reshape(-1, 3)
    return values


def _require_near(where: str, position: Array) -> None:
    away = np.linalg.norm(position, axis=1)
    known = away[np.isfinite(away) & (away > 0)]
    if len(known) and not abs(found := float(np.median(known)) - A) < FAR_M:
        raise UserError(
            f"{where}.position: is {(found + A) / 1e3:.6g} km from the centre of the Earth, which is {A / 1e3:.0f} km"
            " below the ground: is its unit another, or are these no coordinates of the Earth (ECEF)?"
        )
