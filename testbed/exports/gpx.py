"""A record as tracks of GPX 1.1: truth, receivers and estimators. Heights are above the ellipsoid.

Source: GPX 1.1 Schema, https://www.topografix.com/GPX/1/1/
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from testbed.exports.track import tracks, utc
from testbed.exports.view import View

if TYPE_CHECKING:
    import xarray


def content(tree: xarray.DataTree) -> bytes:
    """The file of a record."""
    view = View(tree)
    root = ElementTree.Element(
        "gpx", version="1.1", creator="navigation-testbed", xmlns="http://www.topografix.com/GPX/1/1"
    )
    ElementTree.SubElement(ElementTree.SubElement(root, "metadata"), "name").text = view.title
    for track in tracks(view, receivers=True):
        line = ElementTree.SubElement(root, "trk")
        ElementTree.SubElement(line, "name").text = track.name
        segment = ElementTree.SubElement(line, "trkseg")
        for t, lat, lon, h in zip(track.t, np.degrees(track.lat), np.degrees(track.lon), track.h, strict=True):
            point = ElementTree.SubElement(segment, "trkpt", lat=f"{lat:.9f}", lon=f"{lon:.9f}")
            ElementTree.SubElement(point, "ele").text = f"{h:.3f}"
            ElementTree.SubElement(point, "time").text = utc(view, t)
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
