"""Many steps at once: the same bits as one after the other, whatever the samples are."""

import dataclasses

import numpy as np
import pytest
from worlds.ins import CONSUMER, DT, FIELD_N, airspeed, barometer, flight, gnss, imu, magnetometer

from nav.ahrs import Ahrs, AhrsConfig, AnyMotion
from nav.aids import AirspeedAid, BarometerAid, GnssAid, MagnetometerAid, PositionFixAid
from nav.columns import Samples
from nav.detection import ChiSquare, Eraim
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.monitor import MonitoredAid
from nav.motion import LowDynamics
from nav.samples import NO_SENSOR, FixType, ImuSamples, Outcome, PositionSample

ARM = (0.5, 0.1, -0.3)
AIDS = (
    GnssAid(arm_b=ARM, position_error_sigma=(1.0, 1.0, 2.0), velocity_error_sigma=(0.02, 0.02, 0.03)),
    BarometerAid(),
    MagnetometerAid(soft_iron_sigma=0.005),
    AirspeedAid(gust_sigma=0.5, scale_sigma=0.01),
)
FEDERATION = Config(
    CONSUMER,
    tuple(Local(aid.sensor, (MonitoredAid(aid, lambda: ChiSquare(1e-3)),)) for aid in AIDS),
)
DURATION = 90
# Step by step or not, blocks [s], samples one by one or in columns.
WAYS = (True, 1.0, False), (False, 1.0, False), (False, 7.3, False), (False, 7.3, True), (False, 0.9, True)


class OneByOne:
    """An estimator of which nobody knows that it takes many steps at once."""

    def __init__(self, estimator):
        self.estimator = estimator
        for name in ("propagate", "accepts", "update", "refuse", "estimate", "predict"):
            setattr(self, name, getattr(estimator, name))

    @property
    def listening(self):
        return self.estimator.listening


def sound(offset_s=0.0):
    truth, rng = flight(DURATION), np.random.default_rng(1)
    increments, _, _ = imu(truth, CONSUMER, rng)
    samples = [
        *gnss(truth, rng, 5.0, 1.5, 0.1, ARM, offset_s, latency_s=0.1),
        *barometer(truth, rng),
        *magnetometer(truth, rng),
        *airspeed(truth, rng),
    ]
    return increments, samples


def within(sample, kind, first, last):
    return sample.sensor == kind and first <= sample.t <= last


def rough(increments, samples):
    """Whatever may go wrong, one after the other."""
    made = []
    for sample in samples:
        change = {}
        if within(sample, "gnss", 20, 20.5):
            change = {"lat": sample.lat + 1e-4}
        elif within(sample, "gnss", 24, 24.3):
            change = {"v_n": sample.v_n + 9.0}
        elif within(sample, "gnss", 26, 28):
            change = {"v_n": np.full(3, np.nan)}
        elif within(sample, "gnss", 30, 31):  # of which nothing else counts
            change = {"fix_type": FixType.NO_FIX, "v_n": np.empty(0), "sigma_position_n": None}
        elif within(sample, "gnss", 30, 44):
            change = {"fix_type": FixType.NO_FIX, "lat": np.nan, "v_n": np.full(3, np.nan)}
        elif within(sample, "gnss", 48, 48.5):
            change = {"t_arrival": sample.t + 1.5}
        elif within(sample, "gnss", 50, 50.5):
            change = {"sigma_position_n": np.zeros(3)}
        elif within(sample, "gnss", 51, 51.3):
            change = {"sigma_velocity_n": np.array([0.1, np.inf, 0.1])}
        elif within(sample, "gnss", 53, 53.3):
            change = {"h": 6e4}
        elif within(sample, "gnss", 55, 55.3):
            change = {"lat": 1.6}
        elif within(sample, "gnss", 57, 57.3):
            change = {"v_n": np.array([0.0, 0.0, -601.0])}
        elif within(sample, "gnss", 64, 72):
            change = {"lat": sample.lat + 5e-5}
        elif within(sample, "barometer", 59, 59.3):
            change = {"pressure": -1.0}
        elif within(sample, "magnetometer", 61, 61.3):
            change = {"field_b": np.array([np.nan, 0.0, 0.0])}
        elif within(sample, "magnetometer", 63, 63.3):
            change = {"field_b": np.zeros(3)}
        elif within(sample, "airspeed", 60.5, 61):
            change = {"eas": np.inf}
        elif within(sample, "barometer", 52, 53):
            change = {"pressure": sample.pressure + 500}
        elif within(sample, "barometer", 54, 54.5):
            change = {"pressure": np.nan}
        elif within(sample, "magnetometer", 56, 56.5):
            change = {"field_b": sample.field_b * 0.8}
        elif within(sample, "airspeed", 58, 59):
            change = {"eas": sample.eas - 20}
        elif within(sample, "airspeed", 60, 60.5):
            change = {"eas": 3.0}
        elif within(sample, "airspeed", 62, 70):
            continue
        elif within(sample, "magnetometer", 71, 71.3):
            change = {"t": np.nan}
        made.append(dataclasses.replace(sample, **change))
    for k in (round(75 / DT), round(75.01 / DT)):
        increments.dtheta[k] = np.nan
    return made


def field_n(lat, lon, h):
    return FIELD_N * (1 + 1e-3 * (lat - 0.83))


def in_columns(samples):
    """Those of each sensor as columns, but where a field of one has no number or another shape."""
    handed = []
    for sensor in sorted({sample.sensor for sample in samples}):
        own = [sample for sample in samples if sample.sensor == sensor]
        rows = [[getattr(sample, f.name) for f in dataclasses.fields(sample)[:-1]] for sample in own]
        if len({tuple(np.shape(value) for value in row) for row in rows}) > 1:
            handed += own
            continue
        names = [f.name for f in dataclasses.fields(own[0])[:-1]]
        columns = [
            np.array(column, object if isinstance(column[0], FixType) else None) for column in zip(*rows, strict=True)
        ]
        handed.append(Samples(type(own[0]), sensor, dict(zip(names, columns, strict=True))))
    return handed


def run(one_by_one, ins, increments, samples, block_s, times, columns=False):
    """Reports, estimates and the estimator, pushed in blocks of `block_s`."""
    horizon = FusionHorizon(OneByOne(ins) if one_by_one else ins, lag_s=0.1)
    samples = sorted(samples, key=lambda s: s.t_arrival)
    reports, estimates, taken, size = [], [], 0, round(block_s / DT)
    for start in range(0, len(increments), size):
        rows = slice(start, start + size)
        block = ImuSamples(*(getattr(increments, name)[rows] for name in ("t", "dt", "dtheta", "dv")))
        arrived = []
        while taken < len(samples) and samples[taken].t_arrival <= block.t[-1] + 1e-9:
            arrived.append(samples[taken])
            taken += 1
        asked = [t for t in times if block.t[0] - DT + 1e-9 < t <= block.t[-1] + 1e-9]
        some, told = horizon.track(block, in_columns(arrived) if columns else arrived, asked)
        reports += some
        estimates += told
    return reports, estimates, ins


def same(a, b):
    """Whether two values are the same bit by bit, arrays, numbers, texts and what is made of them."""
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray | float):
        return np.array_equal(a, b, equal_nan=True)
    return a == b


@pytest.mark.ci
@pytest.mark.parametrize(
    ("change", "offset_s", "spoilt"),
    [
        pytest.param({}, 0.0, False, marks=pytest.mark.ci),
        ({}, 0.0123, True),
        pytest.param({"covariance_period": 3}, 0.0, True, marks=pytest.mark.ci),
        pytest.param({"patience_s": 5.0}, 0.0, True, marks=pytest.mark.ci),
        pytest.param({"aids": (*AIDS, PositionFixAid())}, 0.0, False, marks=pytest.mark.ci),
        pytest.param({"aids": AIDS[:2]}, 0.0, True, marks=pytest.mark.ci),
        pytest.param({"aids": ()}, 0.0, False, marks=pytest.mark.ci),
        pytest.param({"false_rejection": 0.0}, 0.0, False, marks=pytest.mark.ci),
    ],
)
def test_the_same_bits_as_one_after_the_other(change, offset_s, spoilt):
    config = dataclasses.replace(InsConfig(CONSUMER, AIDS), **change)
    if "aids" in change:
        config = dataclasses.replace(config, alignment_aids=tuple(a for a in AIDS if a not in change["aids"]))
    times = np.arange(0.1, DURATION - 1, 0.1).tolist()
    results = []
    for one_by_one, block_s, columns in WAYS:
        increments, samples = sound(offset_s)
        if spoilt:
            samples = rough(increments, samples)
        truth = flight(DURATION)
        samples += [
            PositionSample(t, t, truth.lat[k], truth.lon[k], truth.h[k])
            for k, t in ((k, k * DT) for k in range(round(20 / DT), round(60 / DT), round(1 / DT)))
        ]
        results.append(run(one_by_one, Ins(config, field_n), increments, samples, block_s, times, columns))
    (reports, estimates, ins), *others = results
    assert ins.aligned
    assert len({report.outcome for report in reports}) >= (4 if spoilt else min(1, len(config.aids)))
    for some, told, other in others:
        assert len(some) == len(reports)
        assert all(map(same, reports, some))
        assert all(map(same, estimates, told))
        assert np.array_equal(ins._state.whole, other._state.whole)
        assert same(ins._monitor, other._monitor)
        assert same(ins._refusals, other._refusals)
        assert same(ins.realignment._heading._refusals, other.realignment._heading._refusals)


def by_all(P, common, members):
    """Weights (filters,) by whatever covariances are handed over."""
    better = members / np.array([np.linalg.norm(own) for own in P])
    return better / better.sum()


@pytest.mark.ci
@pytest.mark.parametrize(
    "make",
    [
        lambda: Ins(InsConfig(CONSUMER, AIDS), field_n),
        lambda: Federated(FEDERATION, field_n),
        lambda: Federated(dataclasses.replace(FEDERATION, combination="scalar", sharing="none", weigh=by_all), field_n),
    ],
)
def test_estimates_are_made_of_nothing_that_a_draft_lacks(make):
    times, told = np.arange(0.1, DURATION - 1, 0.1).tolist(), []
    size = None
    for _ in range(2):
        estimator, (increments, samples) = make(), sound()
        if size is not None:
            estimator._batch._wholes = np.full((len(times), size), np.nan)
        told.append(run(False, estimator, increments, samples, 7.3, times)[1])
        size = len(estimator._state.whole)
    assert len(told[0]) == len(times)
    assert all(map(same, *told))


@pytest.mark.ci
def test_a_silent_tube_is_stood_in_for_at_the_same_sample():
    """Just when its silence has lasted long enough, wherever a turn ends and times are rounded."""
    times, stood_in = np.arange(0.2, 18.0, 0.2).tolist(), 0
    for silent_from in np.arange(15.0, 15.6, 0.1).tolist():
        found = []
        for one_by_one in (True, False):
            truth, rng = flight(18.0), np.random.default_rng(1)
            increments, _, _ = imu(truth, CONSUMER, rng)
            tube = [sample for sample in airspeed(truth, rng) if sample.t < silent_from + 1e-9]
            samples = [*gnss(truth, rng, 5.0, latency_s=0.1), *barometer(truth, rng), *tube]
            ins = Ins(InsConfig(CONSUMER, (GnssAid(), BarometerAid(), AirspeedAid())), field_n)
            reports, _, _ = run(one_by_one, ins, increments, samples, 0.2, times)
            found.append([report.t for report in reports if report.sensor == NO_SENSOR])
        assert found[0] == found[1]
        stood_in += len(found[0])
    assert stood_in


@pytest.mark.ci
@pytest.mark.parametrize(
    ("change", "detector"),
    [
        pytest.param({}, lambda: ChiSquare(1e-3), marks=pytest.mark.ci),
        ({"structure": "full_reset", "fusion_period_s": 0.25}, lambda: ChiSquare(1e-2)),
        pytest.param({"recall_s": 5.0, "cross_check": True}, lambda: ChiSquare(1e-3), marks=pytest.mark.ci),
        pytest.param({"weighting": "normalised"}, lambda: Eraim(1e-3), marks=pytest.mark.ci),
    ],
)
def test_so_does_a_federation(change, detector):
    receiver, pressure, field, air = (MonitoredAid(aid, detector) for aid in AIDS)
    parts = (Local("gnss", (receiver,)), Local("air", (air, pressure)), Local("field", (field,)))
    config = dataclasses.replace(Config(CONSUMER, parts), **change)
    times = np.arange(0.1, DURATION - 1, 0.1).tolist()
    results = []
    for one_by_one, block_s, columns in WAYS:
        increments, samples = sound(0.0)
        samples = rough(increments, samples)
        results.append(run(one_by_one, Federated(config, field_n), increments, samples, block_s, times, columns))
    (reports, estimates, one), *others = results
    assert one.aligned
    assert len({report.outcome for report in reports}) >= 4
    for some, told, other in others:
        assert len(some) == len(reports)
        assert all(map(same, reports, some))
        assert all(map(same, estimates, told))
        assert same(one.events, other.events)
        for a, b in zip(one.locals, other.locals, strict=True):
            assert all(
                same(x.suspected, y.suspected) for x, y in zip(a.monitors.values(), b.monitors.values(), strict=True)
            )


LOOSE = LowDynamics(1.0, 0.1, 0.1)  # this flight is level now and then
ATTITUDE = AhrsConfig(CONSUMER, 0.83, aids=("magnetometer",), motion=LOOSE, gyro_bias_feedback=True, phi_limit=0.01)
THREE = ("magnetometer", "airspeed", "barometer")
FURTHER = {"gyro_misalignment_sigma": 3e-3, "accel_bias_sigma": 0.03, "gust_sigma": 0.2}


@pytest.mark.ci
@pytest.mark.parametrize(
    ("change", "offset_s", "spoilt", "advised"),
    [
        ({}, 0.0, False, False),
        ({}, 0.0123, True, False),
        ({"aids": THREE}, 0.0, True, True),
        pytest.param(
            {"aids": THREE[1:], "heading": 1.0, "compensated_motion": LowDynamics(2.0, 1.0, 1.0)},
            0.0123,
            True,
            False,
            marks=pytest.mark.ci,
        ),
        pytest.param(
            {"aids": THREE, **FURTHER, "period_s": 0.37, "gyro_bias_feedback": False},
            0.0,
            True,
            False,
            marks=pytest.mark.ci,
        ),
        pytest.param({"aids": ()}, 0.0, True, False, marks=pytest.mark.ci),
        pytest.param(
            {"motion": LowDynamics(4.0, 0.3, 0.3, "vector"), "correction_sigma": 1e-4},
            0.0,
            False,
            False,
            marks=pytest.mark.ci,
        ),
        ({"any_motion": AnyMotion(), "period_s": 0.2}, 0.0, True, False),
        pytest.param({"correction": lambda phi, limit: 0.5 * phi}, 0.0, False, False, marks=pytest.mark.ci),
    ],
)
def test_so_does_an_attitude_filter(change, offset_s, spoilt, advised):
    config = dataclasses.replace(ATTITUDE, **change)
    times = np.arange(0.1, DURATION - 1, 0.1).tolist()
    results = []
    for one_by_one, block_s, columns in WAYS:
        increments, samples = sound()
        if spoilt:
            samples = rough(increments, samples)
        samples = [
            dataclasses.replace(
                s, t=s.t + offset_s, t_arrival=s.t_arrival + offset_s + 0.3 * within(s, s.sensor, 80, 81)
            )
            for s in samples
        ]
        ahrs = Ahrs(config, FIELD_N)
        if advised:
            ahrs.flight_control(increments.t, np.sin(increments.t) < 0.5)
        results.append(run(one_by_one, ahrs, increments, samples, block_s, times, columns))
    (reports, estimates, ahrs), *others = results
    assert ahrs.aligned
    assert ahrs.in_steps is not ({"any_motion", "correction"} & change.keys() != set())
    assert sum(report.aid == "level" for report in reports) > 10
    assert (Outcome.UNSOUND in {report.outcome for report in reports}) is bool(config.aids)
    for some, told, other in others:
        assert len(some) == len(reports)
        assert len(told) == len(estimates)
        assert all(map(same, reports, some))
        assert all(map(same, estimates, told))
        assert same(ahrs._state.whole, other._state.whole)
        assert same(ahrs._airspeed.numbers, other._airspeed.numbers)


def test_an_attitude_filter_takes_a_sound_flight_at_once():
    increments, samples = sound()
    ahrs = Ahrs(dataclasses.replace(ATTITUDE, aids=THREE), FIELD_N)
    horizon, updates = FusionHorizon(ahrs, lag_s=0.1), []
    cut = round(30 / DT)
    for rows in (slice(0, cut), slice(cut, None)):
        block = ImuSamples(*(getattr(increments, name)[rows] for name in ("t", "dt", "dtheta", "dv")))
        horizon.push(block, [s for s in samples if block.t[0] - DT < s.t <= block.t[-1]])
        ahrs.update = lambda sample: updates.append(sample) or []
    assert ahrs.t == increments.t[-1] - 0.1
    assert not updates


def test_most_of_a_sound_flight_is_taken_at_once():
    increments, samples = sound()
    ins = Ins(InsConfig(CONSUMER, AIDS), lambda lat, lon, h: FIELD_N)
    horizon, updates, steps = FusionHorizon(ins, lag_s=0.1), [], []
    update, take = ins.update, ins.take
    ins.update = lambda sample: updates.append(sample) or update(sample)

    def counted(given, *rest):
        steps.append(take(given, *rest))
        return steps[-1]

    ins.take = counted
    cut = round(30 / DT)
    for rows in (slice(0, cut), slice(cut, None)):
        block = ImuSamples(*(getattr(increments, name)[rows] for name in ("t", "dt", "dtheta", "dv")))
        horizon.push(block, [s for s in samples if block.t[0] - DT < s.t <= block.t[-1]])
        updates_of_block = len(updates)
        updates.clear()
    assert sum(steps) > 0.9 * len([s for s in samples if s.t > 30])
    assert updates_of_block < 0.1 * len(samples)
