"""What an own estimator gives may be anything: what can't be used is its own end, and is named."""

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nav.samples import BarometerSample, Estimate, ImuSamples, Outcome, Status, UpdateReport
from testbed import Scenario, run
from testbed.estimators.custom import Adapter
from testbed.estimators.given import DIMENSIONS
from testbed.record import columns
from testbed.record.reader import load
from testbed.score.accuracy import column

TICK_S = 0.005
IMU = ImuSamples(np.array([1.0]), np.array([0.01]), np.zeros((1, 3)), np.zeros((1, 3)))
LATER = dataclasses.replace(IMU, t=np.array([2.0]))
SAMPLE = BarometerSample(1.0, 1.0, 1e5)
SOUND = Estimate.of(1.0, q_nb=np.array([1.0, 0, 0, 0]), lla=np.zeros(3), v_n=np.ones(3), covariance=np.eye(9))
REPORT = UpdateReport(1.0, "gnss", "gnss_position", np.zeros(3), np.eye(3), 1.0, 10.0, 1.0, Outcome.FUSED)


class Giving:
    """Gives what it is told to."""

    def __init__(self, estimate: Any = SOUND, reports: Any = None) -> None:
        self.given, self.reports = estimate, reports

    def propagate(self, imu: ImuSamples) -> None: ...

    def update(self, sample: Any) -> Any:
        return self.reports

    def estimate(self) -> Any:
        return self.given


def told(**changes: Any) -> tuple[Estimate, str]:
    adapter = Adapter(Giving(dataclasses.replace(SOUND, **changes)), TICK_S)
    adapter.propagate(IMU)
    return adapter.estimate(), adapter.failure


def reported(given: Any) -> tuple[list[UpdateReport], str]:
    adapter = Adapter(Giving(reports=given), TICK_S)
    return adapter.update(SAMPLE), adapter.failure


def pair(k: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(k), np.ones(k)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"lat": None}, "estimate: lat is None, not a number"),
        ({"lat": np.array([0.5])}, "estimate: lat is an array of float64 of shape (1,), not a number"),
        ({"h": "500"}, 'estimate: h is "500", not a number'),
        ({"t": None}, "estimate: t is None, not a number"),
        ({"v_n": None}, "estimate: v_n is None, not an array of real numbers"),
        ({"v_n": np.array(["1", "2", "3"])}, "estimate: v_n is an array of <U1 of shape (3,), not an array of real"),
        ({"v_n": np.ones(3) + 1j}, "estimate: v_n is an array of complex128 of shape (3,), not an array of real"),
        ({"v_n": [[1.0], [2.0, 3.0]]}, "estimate: v_n is a list, not an array of numbers"),
        ({"v_n": np.ones((3, 1))}, "estimate: v_n has shape (3, 1), not (3,)"),
        ({"covariance": np.eye(6)}, "estimate: covariance has shape (6, 6), not (9, 9)"),
        ({"lat": 47.0}, "estimate: lat is 47: latitude and longitude are in radians"),
        ({"lon": -8.0}, "estimate: lon is -8: latitude and longitude are in radians, within 6.283 either way"),
        ({"covariance": np.triu(np.ones((9, 9)))}, "estimate: covariance is not symmetric: give 0.5 * (P + P.T)"),
        ({"q_nb": np.zeros(4)}, "estimate: q_nb has length 0, not 1"),
        ({"q_nb": 2 * SOUND.q_nb}, "estimate: q_nb has length 2, not 1"),
        ({"status": None}, "estimate: status is None, not a nav.samples.Status"),
        ({"status": "ALIGNED"}, 'estimate: status is "ALIGNED", not a nav.samples.Status'),
        ({"status": 99999}, "estimate: status is 99999, not a nav.samples.Status"),
        ({"extra": None}, "estimate: extra is None, not further states by name"),
        ({"extra": {"b": (0.0, 1.0)}}, "estimate: extra: b, value has shape (), not (k,)"),
        ({"extra": {"b": np.zeros(2)}}, "estimate: extra: b is an array of float64 of shape (2,), not (value, sigma)"),
        ({"extra": {"b": pair(0)}}, "estimate: extra: b, value has shape (0,), not (k,)"),
        ({"extra": {"b": (np.zeros(2), np.ones(3))}}, "estimate: extra: b, sigma has shape (3,), and its value (2,)"),
        ({"extra": {"b": (np.array(["a"]), np.ones(1))}}, "estimate: extra: b, value is an array of <U1 of shape"),
        ({"extra": {3: pair(1)}}, "estimate: extra: a name is 3, not a text that can be a name"),
        ({"extra": {"a/b": pair(1)}}, 'estimate: extra: a name is "a/b", not a text that can be a name: no slash'),
        ({"extra": {"wind": pair(2), "north_east": pair(1)}}, "extra: north_east can't be a name: the record has"),
        ({"extra": {"h": pair(1)}}, "estimate: extra: h can't be a name: the record has h already"),
        ({"extra": {"gyro_bias": pair(3)}}, "estimate: extra: gyro_bias can't be a name: the record has gyro_bias"),
        ({"extra": {"position_n": pair(3)}}, "extra: position_n can't be a name: the record has sigma_position_n"),
        ({"extra": {"x": pair(1), "sigma_x": pair(1)}}, "extra: sigma_x can't be a name: the record has sigma_x"),
    ],
)
def test_what_is_no_estimate_is_named(changes: dict[str, Any], says: str) -> None:
    estimate, failure = told(**changes)
    assert says in failure
    assert np.isnan(estimate.lat)
    assert estimate.status == Status.ALIGNING


def test_what_only_has_another_type_is_taken() -> None:
    estimate, failure = told(
        lat=np.float32(0.5), h=np.array(3), q_nb=[1, 0, 0, 0], v_n=np.arange(3), status=2, extra={"b": ([1], [2.0])}
    )
    assert failure == ""
    assert (estimate.lat, estimate.h, estimate.status) == (0.5, 3.0, Status.ALIGNED)
    assert {getattr(estimate, name).dtype for name in ("q_nb", "v_n")} == {np.dtype(float)}
    assert isinstance(estimate.status, Status)
    assert [one.tolist() for one in estimate.extra["b"]] == [[1.0], [2.0]]


def test_what_is_masked_is_unknown() -> None:
    estimate, failure = told(v_n=np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False]))
    assert failure == ""
    assert np.array_equal(estimate.v_n, [1.0, np.nan, 3.0], equal_nan=True)


def test_unknown_is_no_mistake() -> None:
    for changes in ({"q_nb": np.full(4, np.nan)}, {"lat": np.nan}, {"covariance": np.full((9, 9), np.nan)}):
        assert told(**changes)[1] == ""


def test_a_covariance_may_be_rounded() -> None:
    rounded = np.diag(np.logspace(-6, 6, 9))
    rounded[0, 8] = 1e-4  # of a correlation
    assert told(covariance=rounded)[1] == ""
    assert told(covariance=-rounded)[1] == ""  # which a remark says


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (lambda a: a.estimate(), "estimate is of 1 s, not of 2 s, the end of the last increment"),
        (lambda a: a.predict(LATER), "estimate is of 1 s, not of 2 s, the end of the last increment"),
    ],
)
def test_an_estimate_of_another_time_is_named(asked: Callable[[Adapter], Any], says: str) -> None:
    """A state of the past was judged as if it were of now, though it said so."""
    adapter = Adapter(Giving(), TICK_S)
    adapter.propagate(IMU)
    assert adapter.estimate().status & Status.ALIGNED
    adapter.propagate(LATER)
    asked(adapter)
    assert adapter.failure == says


def test_a_prediction_is_of_the_end_of_its_increments() -> None:
    class Predicting(Giving):
        def predict(self, imu: ImuSamples) -> Any:
            return self.given

    adapter = Adapter(Predicting(), TICK_S)
    adapter.propagate(IMU)
    adapter.predict(LATER)
    assert adapter.failure == "predict is of 1 s, not of 2 s, the end of the last increment"


def test_the_time_may_be_unknown_or_a_tick_off_or_any_before_alignment() -> None:
    for changes in ({"t": np.nan}, {"t": 0.995}, {"t": 1.005}, {"t": 0.0, "status": Status.ALIGNING}):
        adapter = Adapter(Giving(dataclasses.replace(SOUND, **changes)), TICK_S)
        adapter.propagate(IMU)
        adapter.estimate()
        assert adapter.failure == ""


@pytest.mark.parametrize("ask", [lambda a: a.estimate(), lambda a: a.predict(IMU)])
def test_before_the_first_increment_it_is_no_older_than_the_run_and_no_younger_than_a_sample(
    ask: Callable[[Adapter], Any],
) -> None:
    """Its first estimates were of any time, and told as such."""
    for t, sample in ((-5.0, SAMPLE), (1.1, SAMPLE), (1.0, None), (np.inf, SAMPLE)):
        adapter = Adapter(Giving(dataclasses.replace(SOUND, t=t)), TICK_S)
        if sample is not None:
            adapter.update(sample)
        ask(adapter)
        assert adapter.failure == (
            f"estimate is of {t:g} s, before the first increment: there its t is nan, 0, or that of a sample"
        )
    for t in (np.nan, 0.0, 1.0):
        adapter = Adapter(Giving(dataclasses.replace(SOUND, t=t)), TICK_S)
        adapter.update(dataclasses.replace(SAMPLE, t=np.nan))
        adapter.update(SAMPLE)
        ask(adapter)
        assert adapter.failure == ""


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (5, "update gave 5, not a list of reports"),
        (True, "update gave True, not a list of reports"),
        ("abc", 'update gave "abc", not a list of reports'),
        ([REPORT, {"a": 1}], "update gave a list with a dict in it, not a nav.samples.UpdateReport"),
        ({"innovation": 0.0, "S": 1.0}, "update: a report's innovation has shape (), not (m,)"),
        ({"innovation": None, "S": None}, "update: a report's innovation is None, not an array of real numbers"),
        ({"innovation": np.zeros(2)}, "update: a report's S has shape (3, 3), not (2, 2) as its innovation has 2"),
        ({"outcome": "fused"}, 'update: a report\'s outcome is "fused", not a nav.samples.Outcome'),
        ({"outcome": 99}, "update: a report's outcome is 99, not a nav.samples.Outcome"),
        ({"t": None}, "update: a report's t is None, not a number"),
        ({"weight": None}, "update: a report's weight is None, not a number"),
        ({"nis": "1"}, 'update: a report\'s nis is "1", not a number'),
        ({"aid": "time"}, "update: a report's aid can't be called time: the record has time already"),
        ({"aid": "ned"}, "update: a report's aid can't be called ned: the record has ned already"),
        ({"t": np.nan}, "update: a report's t is nan s, where the run is at 1 s: give that of the sample"),
        ({"t": 1000.0}, "update: a report's t is 1000 s, where the run is at 1 s"),
        ({"weight": -1.0}, "update: a report's weight is -1, below 0"),
        ({"threshold": -1.0}, "update: a report's threshold is -1, below 0"),
        ({"nis": -0.5}, "update: a report's nis is -0.5, below 0"),
        ({"sensor": 3}, "update: a report's sensor is 3, not a text"),
        ({"reason": "\ud800"}, "update: a report's reason is "),
        ({"aid": "mine/x y:z"}, 'update: a report\'s aid is "mine/x y:z", not a text that can be a name: no slash'),
        ({"aid": ""}, 'update: a report\'s aid is "", not a text that can be a name'),
    ],
)
def test_what_is_no_report_is_named(given: Any, says: str) -> None:
    changed = dataclasses.replace(REPORT, **given) if isinstance(given, dict) else given
    reports, failure = reported(changed)
    assert says in failure
    assert reports == []


def test_reports_in_any_wrapping() -> None:
    lists = dataclasses.replace(REPORT, innovation=[0, 0, 0], S=np.eye(3).tolist(), outcome=0)
    for given in (REPORT, [REPORT], (one for one in (REPORT,)), lists):
        (report,), failure = reported(given)
        assert failure == ""
        assert report.innovation.shape == (3,)
        assert report.outcome is Outcome.FUSED
    assert reported(None) == ([], "")


def test_what_no_test_was_made_of_is_unknown() -> None:
    nothing = {"innovation": np.empty(0), "S": np.empty((0, 0))}
    (report,), failure = reported(dataclasses.replace(REPORT, nis=None, threshold=None, **nothing))
    assert failure == ""
    assert np.isnan([report.nis, report.threshold]).all()


@pytest.mark.parametrize("left_out", [None, np.nan])
def test_an_nis_that_is_left_out_is_formed(left_out: float | None) -> None:
    """The record had none, and the score neither nis_mean nor rejected_fraction nor false alarms."""
    nu, S = np.array([3.0, -1.0]), np.array([[4.0, 1.0], [1.0, 2.0]])
    (report,), failure = reported(dataclasses.replace(REPORT, innovation=nu, S=S, nis=left_out))
    assert failure == ""
    assert report.nis == pytest.approx((2 * 3.0**2 + 4 * 1.0**2 + 2 * 3.0) / 7)  # by the adjugate of S


@pytest.mark.parametrize("S", [np.zeros((3, 3)), -np.eye(3), np.full((3, 3), np.nan)])
def test_an_nis_of_no_covariance_is_unknown(S: np.ndarray) -> None:
    (report,), failure = reported(dataclasses.replace(REPORT, S=S, nis=None))
    assert failure == ""
    assert np.isnan(report.nis)


@pytest.mark.parametrize("ask", [lambda a: a.estimate(), lambda a: a.predict(IMU)])
def test_a_filter_may_go_on_in_the_arrays_of_its_estimate(ask: Callable[[Adapter], Estimate]) -> None:
    """What a filter that works in place (``v += ...``) had given became what it knew when the record was written."""
    v, P, states = np.ones(3), np.eye(9), {"b": (np.ones(2), np.ones(2))}
    inner = Giving(dataclasses.replace(SOUND, v_n=v, covariance=P, extra=states))
    inner.predict = lambda imu: inner.given  # type: ignore[attr-defined]
    adapter = Adapter(inner, TICK_S)
    adapter.propagate(IMU)
    given = ask(adapter)
    v += 1.0
    P *= 2.0
    states["b"][0][:] = 5.0
    states["c"] = states["b"]
    assert given.v_n.tolist() == [1.0] * 3
    assert np.array_equal(given.covariance, np.eye(9))
    assert [*given.extra] == ["b"]
    assert given.extra["b"][0].tolist() == [1.0, 1.0]


def test_a_filter_may_begin_without_further_states_in_a_dictionary_of_its_own() -> None:
    states: dict[str, Any] = {}
    adapter = Adapter(Giving(dataclasses.replace(SOUND, extra=states)), TICK_S)
    adapter.propagate(IMU)
    given = adapter.estimate()
    states["b"] = pair(2)
    assert given.extra == {}


def test_a_filter_may_go_on_in_the_arrays_of_its_report() -> None:
    nu, S = np.ones(3), np.eye(3)
    (report,), _ = reported(dataclasses.replace(REPORT, innovation=nu, S=S))
    nu += 1.0
    S *= 2.0
    assert report.innovation.tolist() == [1.0] * 3
    assert np.array_equal(report.S, np.eye(3))


def test_the_names_of_all_dimensions_are_taken() -> None:
    assert {"time", "sample_time", *columns.AXES} == DIMENSIONS


def test_lengths_stay_as_they_were() -> None:
    inner = Giving(dataclasses.replace(SOUND, extra={"b": pair(2)}), REPORT)
    adapter = Adapter(inner, TICK_S)
    adapter.update(SAMPLE)
    inner.reports = dataclasses.replace(REPORT, innovation=np.empty(0), S=np.empty((0, 0)))  # refused before
    adapter.update(SAMPLE)
    assert adapter.failure == ""
    inner.reports = dataclasses.replace(REPORT, innovation=np.zeros(2), S=np.eye(2))
    adapter.update(SAMPLE)
    assert adapter.failure == "update: a report's innovation of gnss_position has 2 numbers, and had 3 before"
    adapter = Adapter(inner, TICK_S)
    adapter.propagate(IMU)
    adapter.estimate()
    inner.given = dataclasses.replace(SOUND, extra={"b": pair(1)})
    adapter.estimate()
    assert adapter.failure == "estimate: extra: b has 1 numbers, and had 2 before"


class Raising(Giving):
    """Raises in what it need not have."""

    def __init__(self, error: BaseException) -> None:
        super().__init__()
        self.error = error

    def _raise(self) -> Any:
        raise self.error

    listening = accepts = refuse = predict = property(_raise)
    propagate = update = _raise  # type: ignore[assignment]


ASKED: list[Callable[[Adapter], Any]] = [
    lambda a: a.listening,
    lambda a: a.accepts(SAMPLE),
    lambda a: a.refuse(SAMPLE, "late"),
    lambda a: a.predict(IMU),
]


@pytest.mark.parametrize("ask", ASKED)
@pytest.mark.parametrize("error", [RuntimeError("no"), SystemExit(3), GeneratorExit("no")])
def test_whatever_it_raises_wherever_ends_it_alone(ask: Callable[[Adapter], Any], error: BaseException) -> None:
    adapter = Adapter(Raising(error), TICK_S)
    ask(adapter)
    assert adapter.failure.startswith(f"{type(error).__name__}: {error} (test_given.py, line")
    assert not adapter.listening
    assert not adapter.accepts(SAMPLE)


class Restless(Giving):
    """Changes what is everybody's, wherever it is asked."""

    def _moves(self, *_: Any) -> Any:
        os.chdir("/")
        np.seterr(all="raise")

    propagate = update = estimate = predict = accepts = refuse = _moves  # type: ignore[assignment]
    listening = property(_moves)


@pytest.mark.parametrize(
    "ask", [*ASKED, lambda a: a.propagate(IMU), lambda a: a.update(SAMPLE), lambda a: a.estimate()]
)
def test_wherever_it_is_asked_working_folder_and_error_state_are_put_back(
    ask: Callable[[Adapter], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = np.geterr()
    ask(Adapter(Restless(), TICK_S))
    assert (Path.cwd(), np.geterr()) == (tmp_path, before)


def test_what_it_raises_is_told_on_one_line() -> None:
    adapter = Adapter(Raising(ValueError("two\nlines, one \x1b[31mred")), TICK_S)
    adapter.predict(IMU)
    assert adapter.failure.startswith(r"ValueError: two lines, one \x1b[31mred (test_given.py, line")


def test_a_method_that_cant_be_called_so_is_named() -> None:
    """Where it is called from is no line of the user's."""

    class Short(Giving):
        def update(self) -> None:  # type: ignore[override]
            ...

    adapter = Adapter(Short(), TICK_S)
    adapter.update(SAMPLE)
    assert adapter.failure.startswith("TypeError: ")
    assert adapter.failure.endswith("Short.update() takes 1 positional argument but 2 were given")


def test_who_stops_the_run_stops_it() -> None:
    with pytest.raises(KeyboardInterrupt):
        Adapter(Raising(KeyboardInterrupt()), TICK_S).listening  # noqa: B018


def test_in_a_thread_there_is_no_interrupt_but_its_own() -> None:
    """A campaign's worker died of it, and was said to be out of memory."""
    adapter = Adapter(Raising(KeyboardInterrupt()), TICK_S)
    with ThreadPoolExecutor(1) as pool:
        assert not pool.submit(lambda: adapter.listening).result()
    assert adapter.failure.startswith("RuntimeError: KeyboardInterrupt, where nobody interrupted (test_given.py, line")


UNUSUAL = """
import numpy as np
from nav.samples import Estimate, GnssSample, Outcome, UpdateReport


class Unusual:
    def __init__(self, rig):
        self.t, self.fix = 0.0, None

    def propagate(self, imu):
        self.t = imu.t[-1]

    def update(self, sample):
        if isinstance(sample, GnssSample) and sample.has_fix:
            self.fix = sample
            numbers = 1.0, 10.0, 1.0, Outcome.FUSED
            return UpdateReport(sample.t, sample.sensor, "gnss_position", np.zeros(2), np.eye(2), *numbers)

    def estimate(self):
        if self.fix is None:
            return Estimate.of(self.t)
        lla, extra = np.array([self.fix.lat, self.fix.lon, self.fix.h]), {"wind": (np.zeros(3), np.ones(3))}
        return Estimate.of(self.t, q_nb=np.array([1.0, 0, 0, 0]), lla=lla, v_n=self.fix.v_n, extra=extra)
"""


def test_an_estimate_of_an_impossible_time_is_no_event(tmp_path: Path) -> None:
    """Aligned at -5 s, said the record, of one that was refused for that."""
    early = UNUSUAL.replace("self.fix is None", "False").replace(
        "[self.fix.lat, self.fix.lon, self.fix.h]", "[0.8, 0, 0]"
    )
    early = early.replace("Estimate.of(self.t, q_nb", "Estimate.of(-5.0, q_nb").replace("v_n=self.fix.v_n, ", "")
    result = run(Scenario.load(written(tmp_path, early), {"duration_s": 1, "expect": {}}))
    (told,) = [one for one in result.dataset["events"]["text"].values.tolist() if one.startswith("own ")]
    assert told.startswith("own has ended: estimate is of -5 s, before the first increment")
    assert (result.dataset["events"]["time"].values >= 0.0).all()
    assert (result.dataset["estimators/own/time"].values >= 0.0).all()


def written(folder: Path, text: str) -> Path:
    """A scenario with an estimator of the user's alone."""
    (folder / "unusual.py").write_text(text)
    text = (Path(__file__).parents[2] / "scenarios/u_turn.toml").read_text("utf-8").partition("[[estimator]]")[0]
    (folder / "own.toml").write_text(f'{text}\n[[estimator]]\nname = "own"\nkind = "./unusual.py:Unusual"\n', "utf-8")
    return folder / "own.toml"


def test_a_known_name_for_another_thing_is_recorded(tmp_path: Path) -> None:
    """Position of two components, wind of three: their own components, not north, east and down."""
    result = run(Scenario.load(written(tmp_path, UNUSUAL), {"duration_s": 5, "expect": {}}), out=tmp_path / "out")
    assert not [one for one in result.remarks if "has ended" in one]
    record = load(tmp_path / "out/run.nc")
    assert column(record, "estimators/own/innovations/gnss_position/innovation").shape[1:] == (2,)
    assert column(record, "estimators/own/wind").shape[1:] == (3,)
    assert np.isfinite(column(record, "estimators/own/sigma_wind")[-1]).all()
