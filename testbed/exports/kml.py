"""A record for Google Earth: tracks over time, stretches without GNSS in red, 95 % ellipses every half minute.

Heights are above the ellipsoid, where Google Earth means the sea's level. Source: OGC KML 2.2, and its extension
``gx:Track``, https://developers.google.com/kml/documentation/kmlreference
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from nav.samples import Array
from testbed.exports.track import TRUTH, Track, outlines, tracks, utc
from testbed.exports.view import View

if TYPE_CHECKING:
    import xarray

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
# Colours that colour-blind people tell apart (Okabe and Ito), as aabbggrr.
TRUE, DENIED, ESTIMATED = "ff000000", "ff005ed5", ("ffb27200", "ff739e00", "ff009fe6", "ffa779cc", "ffe9b456")


def content(tree: xarray.DataTree) -> bytes:
    """The file of a record."""
    view = View(tree)
    ElementTree.register_namespace("", KML)
    ElementTree.register_namespace("gx", GX)
    root = ElementTree.Element(_name("kml"))
    document = _with(root, "Document", name=view.title)
    for k, track in enumerate(tracks(view)):
        colour = TRUE if track.name == TRUTH else ESTIMATED[(k - 1) % len(ESTIMATED)]
        folder = _with(document, "Folder", name=track.name)
        _line(view, folder, track, colour)
        if track.name == TRUTH:
            for start, end in view.denied:
                _denied(folder, track, start, end)
        for t, corners in outlines(track) if track.estimated else ():
            _ellipse(view, folder, t, corners, colour)
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _name(tag: str) -> str:
    return f"{{{GX if tag[:3] == 'gx:' else KML}}}{tag.removeprefix('gx:')}"


def _with(parent: ElementTree.Element, tag: str, **texts: str) -> ElementTree.Element:
    """A new element in another, with elements of text in it."""
    made = ElementTree.SubElement(parent, _name(tag))
    for name, text in texts.items():
        ElementTree.SubElement(made, _name(name)).text = text
    return made


def _placemark(
    folder: ElementTree.Element, name: str, colour: str, width: str = "2", when: str = ""
) -> ElementTree.Element:
    mark = _with(folder, "Placemark", name=name)
    if when:
        _with(mark, "TimeStamp", when=when)
    style = _with(mark, "Style")
    _with(style, "LineStyle", color=colour, width=width)
    _with(style, "PolyStyle", color="40" + colour[2:])
    return mark


def _line(view: View, folder: ElementTree.Element, track: Track, colour: str) -> None:
    line = _with(_placemark(folder, track.name, colour), "gx:Track", altitudeMode="absolute")
    for t in track.t:
        ElementTree.SubElement(line, _name("when")).text = utc(view, t)
    for place in _places(track.lat, track.lon, track.h, " "):
        ElementTree.SubElement(line, _name("gx:coord")).text = place


def _denied(folder: ElementTree.Element, track: Track, start: float, end: float) -> None:
    """The stretch of a track, nothing where no two places of it are known: they make a line."""
    inside = (track.t >= start) & (track.t <= end)
    if inside.sum() < 2:
        return
    line = _with(_placemark(folder, f"no GNSS, {start:g} to {end:g} s", DENIED, "5"), "LineString")
    ElementTree.SubElement(line, _name("altitudeMode")).text = "absolute"
    places = " ".join(_places(track.lat[inside], track.lon[inside], track.h[inside], ","))
    ElementTree.SubElement(line, _name("coordinates")).text = places


def _ellipse(view: View, folder: ElementTree.Element, t: float, corners: Array, colour: str) -> None:
    lat, lon, h = corners.T
    mark = _placemark(folder, f"95 % at {t:g} s", colour, "1", utc(view, t))
    ring = _with(_with(_with(mark, "Polygon", altitudeMode="absolute"), "outerBoundaryIs"), "LinearRing")
    ElementTree.SubElement(ring, _name("coordinates")).text = " ".join(_places(lat, lon, h, ","))


def _places(lat: Array, lon: Array, h: Array, between: str) -> list[str]:
    degrees = zip(np.degrees(lon), np.degrees(lat), h, strict=True)
    return [between.join((f"{a:.9f}", f"{b:.9f}", f"{c:.3f}")) for a, b, c in degrees]
