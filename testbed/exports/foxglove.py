"""A record as an MCAP file with Foxglove's messages in JSON: locations, poses, inertial samples, log texts.

Poses are in ``map``, east-north-up from the first place of truth, of a body with forward-left-up axes, as viewers want
it. Sources: Foxglove schemas LocationFix, PoseInFrame and Log, https://docs.foxglove.dev/docs/visualization/message-schemas;
ROS's sensor_msgs/Imu for the fields of an inertial sample.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from nav.earth import position_difference_n
from nav.samples import Array
from testbed.exports.track import Track, tracks
from testbed.exports.view import Columns, View, only, turned

if TYPE_CHECKING:
    import xarray

ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FRD = np.diag([1.0, -1.0, -1.0])
KNOWN, UNKNOWN = 3, 0  # of a covariance
LEVELS = {"info": 2, "warning": 3, "error": 4}
NUMBER = {"type": "number"}
TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


VECTOR = _object(x=NUMBER, y=NUMBER, z=NUMBER)
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.LocationFix": _object(
        timestamp=TIME,
        frame_id={"type": "string"},
        latitude=NUMBER,
        longitude=NUMBER,
        altitude=NUMBER,
        position_covariance={"type": "array", "items": NUMBER},
        position_covariance_type={"type": "integer"},
    ),
    "foxglove.PoseInFrame": _object(
        timestamp=TIME,
        frame_id={"type": "string"},
        pose=_object(position=VECTOR, orientation=_object(x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)),
    ),
    "foxglove.Log": _object(timestamp=TIME, level={"type": "integer"}, message={"type": "string"}),
    "Imu": _object(timestamp=TIME, frame_id={"type": "string"}, angular_velocity=VECTOR, linear_acceleration=VECTOR),
}


def content(tree: xarray.DataTree) -> bytes:
    """The file of a record."""
    from mcap.writer import Writer

    view = View(tree)
    start_ns = int(view.midnight.timestamp()) * 10**9
    file = io.BytesIO()
    writer: Any = Writer(file)
    writer.start(library="navigation-testbed")
    schemas = {name: writer.register_schema(name, "jsonschema", json.dumps(s).encode()) for name, s in SCHEMAS.items()}
    channels: dict[str, int] = {}
    for count, (t, topic, schema, message) in enumerate(sorted(_messages(view), key=lambda one: one[0])):
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "json", schemas[schema])
        ns = start_ns + round(t * 1e9)
        whole = {"timestamp": {"sec": ns // 10**9, "nsec": ns % 10**9}, **message}
        writer.add_message(
            channels[topic], log_time=ns, publish_time=ns, sequence=count, data=json.dumps(whole).encode()
        )
    writer.finish()
    return file.getvalue()


def _messages(view: View) -> Iterator[tuple[float, str, str, dict[str, Any]]]:
    """Time [s], topic, schema and content of every message."""
    for track in tracks(view, receivers=True):
        room = "estimators/" if track.estimated else "sensors/" if track.name in view.sensors["gnss"] else ""
        for t, place in _locations(track):
            yield t, f"/{room}{track.name}/location", "foxglove.LocationFix", place
    for topic, own in {"truth": view.truth, **{f"estimators/{k}": own for k, own in view.estimators.items()}}.items():
        for t, pose in _poses(view, own):
            yield t, f"/{topic}/pose", "foxglove.PoseInFrame", pose
    for name, own in view.sensors["imu"].items():
        dt = own["dt"][:, None]
        for t, w, f in zip(own["time"], own["dtheta"] / dt @ FLU_FRD, own["dv"] / dt @ FLU_FRD, strict=True):
            said = {"frame_id": "body", "angular_velocity": _vector(w), "linear_acceleration": _vector(f)}
            yield float(t), f"/sensors/{name}", "Imu", said
    for t, severity, text in view.events:
        yield t, "/events", "foxglove.Log", {"level": LEVELS[severity], "message": text}


def _locations(track: Track) -> Iterator[tuple[float, dict[str, Any]]]:
    covariance = ENU_NED @ track.covariance @ ENU_NED.T
    for k, t in enumerate(track.t):
        known = bool(np.isfinite(covariance[k]).all())
        yield (
            float(t),
            {
                "frame_id": "map",
                "latitude": float(np.degrees(track.lat[k])),
                "longitude": float(np.degrees(track.lon[k])),
                "altitude": float(track.h[k]),
                "position_covariance": covariance[k].ravel().tolist() if known else [0.0] * 9,
                "position_covariance_type": KNOWN if known else UNKNOWN,
            },
        )


def _poses(view: View, own: Columns) -> Iterator[tuple[float, dict[str, Any]]]:
    """Attitudes where a place is known; of one that knows none, at the origin."""
    own = only(own, turned(own))
    if not len(own["time"]):
        return
    lat0, lon0, h0 = (np.array(x) for x in view.origin())
    place = position_difference_n(own["lat"], own["lon"], own["h"], lat0, lon0, h0) @ ENU_NED.T
    attitude = Rotation.from_quat(np.roll(own["q_nb"], -1, axis=-1))  # the scalar last
    orientations = (Rotation.from_matrix(ENU_NED) * attitude * Rotation.from_matrix(FLU_FRD)).as_quat()
    for t, p, q in zip(own["time"], np.nan_to_num(place), orientations, strict=True):
        orientation = dict(zip("xyzw", map(float, q), strict=True))
        yield float(t), {"frame_id": "map", "pose": {"position": _vector(p), "orientation": orientation}}


def _vector(values: Array) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))
