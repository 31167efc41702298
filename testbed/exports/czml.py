"""A record for Cesium: positions and 95 % ellipses over time, stretches without GNSS as lines of their own.

Source: CZML Guide, https://github.com/AnalyticalGraphicsInc/czml-writer/wiki/CZML-Guide; the rotation of an ellipse
counts counter-clockwise from north.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.exports.track import TRUTH, Track, ellipse, tracks, utc
from testbed.exports.view import View

if TYPE_CHECKING:
    import xarray

# Colours that colour-blind people tell apart (Okabe and Ito).
TRUE, DENIED = (255, 255, 255), (213, 94, 0)
ESTIMATED = ((0, 114, 178), (0, 158, 115), (230, 159, 0), (204, 121, 167), (86, 180, 233))


def content(tree: xarray.DataTree) -> bytes:
    """The file of a record."""
    view = View(tree)
    found = tracks(view)
    span = f"{utc(view, 0.0)}/{utc(view, max((float(one.t[-1]) for one in found), default=0.0))}"
    clock = {"interval": span, "currentTime": utc(view, 0.0), "multiplier": 10}
    packets: list[dict[str, Any]] = [{"id": "document", "name": view.title, "version": "1.0", "clock": clock}]
    for k, track in enumerate(found):
        colour = TRUE if track.name == TRUTH else ESTIMATED[(k - 1) % len(ESTIMATED)]
        packets.append(_moving(view, track, colour))
        if track.name == TRUTH:
            packets += [packet for start, end in view.denied for packet in _denied(track, start, end)]
    return json.dumps(packets, indent=1).encode()


def _moving(view: View, track: Track, colour: tuple[int, int, int]) -> dict[str, Any]:
    epoch, paint = utc(view, 0.0), {"solidColor": {"color": {"rgba": [*colour, 255]}}}
    packet: dict[str, Any] = {
        "id": track.name,
        "name": track.name,
        "availability": f"{utc(view, float(track.t[0]))}/{utc(view, float(track.t[-1]))}",
        "position": {"epoch": epoch, "cartographicDegrees": _flat(track.t, *_degrees(track))},
        "point": {"pixelSize": 8, "color": {"rgba": [*colour, 255]}},
        "path": {"width": 2, "leadTime": 0, "material": paint},
    }
    if track.estimated and np.isfinite(track.covariance).all():
        larger, smaller, azimuth = ellipse(track.covariance)
        turned = np.unwrap(2 * azimuth) / 2  # an axis turned by half a turn is the same: no jumps between samples
        packet["ellipse"] = {
            "semiMajorAxis": {"epoch": epoch, "number": _flat(track.t, larger)},
            "semiMinorAxis": {"epoch": epoch, "number": _flat(track.t, np.minimum(smaller, larger))},
            "rotation": {"epoch": epoch, "number": _flat(track.t, -turned)},
            "height": {"epoch": epoch, "number": _flat(track.t, track.h)},
            "material": {"solidColor": {"color": {"rgba": [*colour, 64]}}},
        }
    return packet


def _denied(track: Track, start: float, end: float) -> list[dict[str, Any]]:
    """The stretch of a track, nothing where no two places of it are known: they make a line."""
    inside = (track.t >= start) & (track.t <= end)
    if inside.sum() < 2:
        return []
    lon, lat, h = (values[inside] for values in _degrees(track))
    paint = {"solidColor": {"color": {"rgba": [*DENIED, 255]}}}
    line = {"positions": {"cartographicDegrees": _flat(lon, lat, h)}, "width": 5, "material": paint}
    return [{"id": f"denied {start:g}", "name": f"no GNSS, {start:g} to {end:g} s", "polyline": line}]


def _degrees(track: Track) -> tuple[Array, Array, Array]:
    return np.degrees(track.lon), np.degrees(track.lat), track.h


def _flat(*columns: Array) -> list[float]:
    """Columns (N,) row by row, to a tenth of a millimetre of a degree."""
    return [float(value) for value in np.column_stack(columns).round(9).ravel()]
