import itertools
import math
import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pymavlink.dialects.v20 import all as mav
from worlds.loop import one_row

from nav.samples import (
    AirspeedSample,
    BarometerSample,
    Estimate,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Outcome,
    Status,
    UpdateReport,
)
from testbed import Scenario
from testbed.mavlink import MavlinkPublisher, encode, messages
from testbed.mavlink.history import History, Speech
from testbed.mavlink.stream import STREAMS
from testbed.motion.table import COLUMNS, TruthBlock

SCENARIO = Scenario.load("u_turn")
CLASSES = {message.msgname: message for message in mav.mavlink_map.values()}
NAMES = sorted({stream.message for stream in STREAMS} | {"STATUSTEXT"})
RANGES = {
    "uint8_t": (0, 2**8 - 1),
    "int8_t": (-(2**7), 2**7 - 1),
    "uint16_t": (0, 2**16 - 1),
    "int16_t": (-(2**15), 2**15 - 1),
    "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**64 - 1),
}
# Floats as they come, and those that sit at the edges of the fields' ranges.
numbers = st.floats() | st.sampled_from([0.5, -0.5, 32767.5, -32768.5, 65535.5, 2.0**31, 2.0**32, 2.0**64, 1e39, -1e39])


def decode(frame):
    """The one message in ``frame``, by pymavlink's parser, checksum and all."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = False
    (message,) = parser.parse_buffer(bytearray(frame))
    return message


def shape(name):
    """(field, type, number of elements or 0) in the order of pymavlink's constructor."""
    message = CLASSES[name]
    lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
    return [(f, kind, lengths[f]) for f, kind in zip(message.fieldnames, message.fieldtypes, strict=True)]


@st.composite
def fields(draw, name):
    values = {}
    for field, kind, length in shape(name):
        if kind == "char":
            values[field] = draw(st.binary(max_size=length))
        elif length:
            values[field] = draw(st.lists(numbers, min_size=length, max_size=length))
        else:
            values[field] = draw(numbers)
    return values


def same(decoded, expected):
    return decoded == expected or (math.isnan(decoded) and math.isnan(expected))


@pytest.mark.ci
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=settings.default.max_examples // 6)  # of each message
@given(data=st.data())
def test_any_number_in_any_field(name, data):
    values = data.draw(fields(name))
    message = decode(encode.Encoder().frame(name, values))
    assert message.get_type() == name
    for field, kind, length in shape(name):
        if kind == "char":
            continue
        decoded, sent = getattr(message, field), values[field]
        for got, given_value in zip(decoded, sent, strict=True) if length else [(decoded, sent)]:
            if kind == "float":
                bounded = given_value
                if math.isfinite(given_value):
                    bounded = max(-3.4028234663852886e38, min(3.4028234663852886e38, given_value))
                assert same(got, struct.unpack("<f", struct.pack("<f", bounded))[0])
            elif math.isnan(given_value):
                assert got in (0, RANGES[kind][1])
            else:
                low, high = RANGES[kind]
                assert got == round(max(low, min(high, given_value)))


@pytest.mark.parametrize("name", NAMES)
def test_same_bytes_as_pymavlink(name):
    values = {}
    for position, (field, kind, length) in enumerate(shape(name)):
        if kind == "char":
            values[field] = b"text"
        elif kind == "float":
            values[field] = [position + 0.25 * k for k in range(length)] if length else position + 0.5
        else:
            values[field] = position % 100
    encoder = encode.Encoder(system=3, component=1)
    peer = mav.MAVLink(None, srcSystem=3, srcComponent=1)
    for _ in range(257):  # the sequence number wraps
        assert encoder.frame(name, values) == CLASSES[name](**values).pack(peer)
        peer.seq = (peer.seq + 1) % 256


def recorded(said, system=3):
    """Frames of messages with their fields as a log has them."""
    history = History()
    for k, one in enumerate(said):
        history.add([k], [Speech(system, [(0, *one)])])
    frames = list(logged(history.take()))
    assert [stamp for stamp, _ in frames] == list(range(len(said)))
    return [frame for _, frame in frames]


@pytest.mark.parametrize("name", NAMES)
def test_a_log_has_the_same_bytes_as_one_frame_after_the_other(name):
    encoder, values = encode.Encoder(system=3), []
    for k in range(300):  # the number wraps, and trailing zeros come and go
        values.append({})
        for field, kind, length in shape(name):
            number = k % 100 + 0.5 * (kind == "float") if k % 3 else 0
            values[-1][field] = b"text" * (k % 3) if kind == "char" else [number] * length if length else number
    assert recorded([(name, one) for one in values]) == [encoder.frame(name, one) for one in values]


@pytest.mark.ci
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=settings.default.max_examples // 6)
@given(data=st.data())
def test_many_payloads_are_those_of_one_after_the_other(name, data):
    rows = [data.draw(fields(name)) for _ in range(3)]
    columns = {
        field: rows[0][field] if kind == "char" else np.array([row[field] for row in rows])
        for field, kind, _ in shape(name)
    }
    for row in rows:
        row.update({field: rows[0][field] for field, kind, _ in shape(name) if kind == "char"})
    own = encode.layout(name)
    found = [bytes(payload) for payload in own.payloads(columns, 3)]
    assert [encode.Encoder().wrap(name, one) for one in found] == [encode.Encoder().frame(name, row) for row in rows]


def test_fields_must_be_complete():
    with pytest.raises(KeyError, match="pitch"):
        encode.Encoder().frame("ATTITUDE", {"time_boot_ms": 0, "roll": 0.0})


def global_position(**changes):
    values = dict.fromkeys(CLASSES["GLOBAL_POSITION_INT"].fieldnames, 0.0)
    return decode(encode.Encoder().frame("GLOBAL_POSITION_INT", values | changes))


def test_saturation():
    message = global_position(vx=40000.0, vy=-40000.0, alt=3e9, lat=math.inf, hdg=math.nan, vz=math.nan)
    assert (message.vx, message.vy, message.alt, message.lat) == (32767, -32768, 2**31 - 1, 2**31 - 1)
    assert message.hdg == 65535
    assert message.vz == 0


@pytest.mark.parametrize(
    ("degrees", "hundredths"),
    [(0, 0), (-0.001, 0), (-90, 27000), (359.994, 35999), (359.996, 0), (360, 0), (725, 500), (-180, 18000)],
)
def test_heading_wraps(degrees, hundredths):
    assert encode.centidegrees(math.radians(degrees)) == hundredths


def test_unknown_heading():
    assert math.isnan(encode.centidegrees(math.nan))
    assert math.isnan(encode.centidegrees(math.inf))


def test_latitude_and_longitude():
    assert encode.latitude_e7(math.radians(-33.8688)) == pytest.approx(-33.8688e7)
    assert encode.latitude_e7(1e300) == 90e7
    assert encode.latitude_e7(-math.inf) == -90e7
    assert math.isnan(encode.latitude_e7(math.nan))
    assert encode.longitude_e7(math.radians(190)) == pytest.approx(-170e7)
    assert encode.longitude_e7(math.radians(-179.9999999)) == pytest.approx(-179.9999999e7)
    assert math.isnan(encode.longitude_e7(math.inf))


def test_time_wraps():
    assert encode.boot_ms(12.3456) == 12346
    assert encode.boot_ms(2**32 / 1e3 + 1) == 1000
    assert encode.boot_ms(-0.001) == 2**32 - 1
    assert encode.boot_ms(math.nan) == 0
    assert encode.microseconds(1.5) == 1_500_000
    assert encode.microseconds(math.inf) == 0


def logged(data):
    """Stamps [us] and frames in the bytes of a log."""
    while data:
        size = 8 + 12 + data[9]
        yield int.from_bytes(data[:8], "big"), data[8:size]
        data = data[size:]


class Deal:
    """Deals out the numbers of an array, one or a few at a time, over and over."""

    def __init__(self, numbers):
        self.numbers = itertools.cycle(numbers.tolist())

    def __call__(self):
        return next(self.numbers)

    def vector(self, n):
        return np.array([self() for _ in range(n)])


class Collector:
    """A log that keeps the frames that it is given."""

    def __init__(self):
        self.frames = []

    def write(self, data):
        self.frames += [frame for _, frame in logged(data)]

    def close(self):
        pass


def estimate(deal, status):
    return Estimate(
        t=deal(),
        lat=deal(),
        lon=deal(),
        h=deal(),
        v_n=deal.vector(3),
        q_nb=deal.vector(4),
        gyro_bias=deal.vector(3),
        accel_bias=deal.vector(3),
        covariance=deal.vector(81).reshape(9, 9),
        sigma_gyro_bias=deal.vector(3),
        sigma_accel_bias=deal.vector(3),
        status=status,
        extra={"wind": (deal.vector(2), deal.vector(2))},
    )


def broken_run(deal, status, fix):
    """A row of a run gone completely wrong."""
    truth = TruthBlock.empty(8, 1)
    for name, column in COLUMNS.items():
        getattr(truth, name)[0] = deal() if column.width == 1 else deal.vector(column.width)
    now = float(truth.t[0])
    samples = [
        GnssSample(
            t=now,
            t_arrival=now,
            lat=deal(),
            lon=deal(),
            h=deal(),
            v_n=deal.vector(3),
            sigma_position_n=deal.vector(3),
            sigma_velocity_n=deal.vector(3),
            fix_type=fix,
            satellites=1000,
            hdop=deal(),
            vdop=deal(),
        ),
        BarometerSample(now, now, deal()),
        MagnetometerSample(now, now, deal.vector(3)),
        AirspeedSample(now, now, deal()),
    ]
    imu = ImuSamples(deal.vector(2), deal.vector(2), deal.vector(6).reshape(2, 3), deal.vector(6).reshape(2, 3))
    others = [("second", estimate(deal, status)), ("third", estimate(deal, status))]
    reports = [
        UpdateReport(now, "gnss", "gnss_position", deal.vector(3), np.eye(3), deal(), deal(), 1.0, Outcome.FUSED)
    ]
    return one_row(truth, estimate(deal, status), {s.sensor: s for s in samples}, imu, others, reports)


@pytest.mark.ci
@pytest.mark.parametrize("vehicles", [False, True])
@example(state=np.full(397, math.nan), before=np.full(397, math.nan), status=Status.ALIGNED, fix=FixType.FIX_3D)
@example(state=np.full(397, math.inf), before=np.full(397, -math.inf), status=Status.ALIGNED, fix=FixType.NO_FIX)
@given(
    state=arrays(np.float64, 397, elements=numbers),
    before=arrays(np.float64, 397, elements=numbers),
    status=st.sampled_from([Status.ALIGNING, Status.ALIGNED, Status.ALIGNED | Status.DEAD_RECKONING]),
    fix=st.sampled_from(FixType),
)
def test_no_state_can_stop_the_stream(vehicles, state, before, status, fix):
    link = Collector()
    publisher = MavlinkPublisher([], SCENARIO, vehicles=vehicles)
    publisher._logs.append(link)
    publisher.publish(broken_run(Deal(before), status, fix))  # whatever came first, home and IMU included
    publisher._write()
    publisher._calls = 0  # every stream is due
    link.frames.clear()
    publisher.publish(broken_run(Deal(state), status, fix))
    publisher._write()
    names = [decode(frame).get_type() for frame in link.frames]
    assert {"HEARTBEAT", "SYS_STATUS", "GPS_RAW_INT", "HIGHRES_IMU"} <= set(names)
    if np.isfinite(state).all():  # where truth is not known it is not sent
        assert "HIL_STATE_QUATERNION" in names
    if status == Status.ALIGNING and not vehicles:
        assert not {"ATTITUDE", "GLOBAL_POSITION_INT", "ODOMETRY", "AHRS2"} & set(names)
    for vehicle in (publisher._main, *publisher._beside):  # what is asked for is made of the same numbers
        vehicle.heartbeat()
        for stream in STREAMS:
            vehicle.frame(stream)


@given(text=st.text(max_size=300) | st.text("aé", min_size=20, max_size=110), number=st.integers(0, 10**6))
@example(text="x" * 50, number=0)
@example(text="x" * 51, number=0)
@example(text="x" * 100, number=2**16 - 2)
def test_text_survives_its_chunks(text, number):
    encoder = encode.Encoder()
    chunks = [decode(encoder.frame("STATUSTEXT", chunk)) for chunk in messages.statustext("warning", text, number)]
    # As a ground station does it: the bytes of all chunks in order, up to the zero that ends the text.
    raw = b"".join(chunk._text_raw.ljust(50, b"\0") for chunk in chunks)
    assert raw.rstrip(b"\0") == text.replace("\0", " ").encode(errors="replace")
    assert [chunk.chunk_seq for chunk in chunks] == list(range(len(chunks)))
    assert {chunk.severity for chunk in chunks} == {mav.MAV_SEVERITY_WARNING}
    if len(chunks) == 1:
        assert chunks[0].id == 0
    else:
        assert len({chunk.id for chunk in chunks}) == 1
        assert chunks[0].id > 0
        assert all(len(chunk._text_raw) == 50 for chunk in chunks[:-1])
        assert len(chunks[-1]._text_raw) < 50


def test_endless_text_is_cut():
    assert len(messages.statustext("info", "x" * 10**6, 0)) <= 256
