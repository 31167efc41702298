"""Figures of a run with many estimators, an outage and a fault: all is told apart, explained and in its place."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import allantools
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.signal import welch
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.observability import Visibility
from testbed.record.recorder import Recorder
from testbed.report import style
from testbed.report.figures import CHAPTERS, consistency, errors, flight, imu
from testbed.report.run import Run
from testbed.sensors.faults import FaultTruth

NAMES = ("ins", "dead_reckoning", "late", "other", "federated_with_a_long_name", "ukf", "ahrs", "gyros_alone")
DENIED = ((70.0, 100.0),)
# Drawn with time as their axis, so that outages and faults are shaded in them.
TIMED = {
    "flight", "wind", "comparison", "attitude", "nees", "visibility", "position_errors", "motion_errors",
    "attitude_errors", "biases", "innovations",
}  # fmt: skip


@pytest.fixture(scope="module")
def run() -> Run:
    made = scenario(150.0)
    made.estimator = [SimpleNamespace(name=name, imu="imu", recorded=(name,)) for name in NAMES]
    recorder = Recorder(None, made, 1)
    recorder.faults([FaultTruth("jump", "barometer", "height", "step", 80.0, 90.0, 3.0, "m")])
    own = {name: Errors(sigma_position=1.0 + k) for k, name in enumerate(NAMES)}
    own["dead_reckoning"] = Errors(drift_mps=300.0)
    synthetic_run.record(recorder, circle(150.0), own, DENIED)
    run = Run(recorder.dataset())
    t, share = np.linspace(0.0, 150.0, 6), np.full((5, 2), 0.5)
    run.seen = {name: Visibility(["phi down", "wind 1"], t, np.ones(5, int), share, share, share) for name in NAMES[:5]}
    return run


@pytest.fixture(scope="module")
def drawn(run: Run) -> dict[str, Figure]:
    """All figures of the run by file name, drawn once so that everything has its place."""
    chapters = [replace(c, subjects=lambda _: ["dead_reckoning"]) if c.title == "{}" else c for c in CHAPTERS]
    made = {name: figure for chapter in chapters for _, _, name, _, figure in chapter.drawn(run)}
    for figure in made.values():
        figure.canvas.draw()
    return made


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()] if figure.legends else []


def seen(axes: Any) -> list[Any]:
    return [ax for ax in axes if ax.get_visible()]


def test_no_file_has_two_figures() -> None:
    names = [plot.name for chapter in CHAPTERS for plot in chapter.plots]
    assert len(names) == len(set(names))


@pytest.mark.ci
def test_estimators_are_told_apart(run: Run, drawn: dict[str, Figure]) -> None:
    assert len({(line["color"], line["ls"]) for line in map(style.line_of, range(30))}) == 30
    for name in ("comparison", "ground_track", "attitude", "wind", "ellipses"):
        for line in (line for ax in drawn[name].axes for line in ax.get_lines() if line.get_label() in NAMES):
            assert (line.get_color(), line.get_linestyle()) == tuple(run.lines[line.get_label()].values())


@pytest.mark.ci
def test_legends_are_whole_and_above_everything(drawn: dict[str, Figure]) -> None:
    for name, figure in drawn.items():
        if not figure.legends:
            continue
        box, page = figure.legends[0].get_window_extent(), figure.bbox
        assert box.x0 >= 0, name
        assert box.y1 <= page.y1 + 1, name
        for ax in seen(figure.axes):
            assert box.y0 >= ax.get_window_extent().y1, name
            for title in (ax.title, ax._left_title, ax._right_title):
                assert not title.get_text() or title.get_window_extent().y1 <= box.y0 + 1, name
    assert set(NAMES) <= set(legend(drawn["comparison"]))


@pytest.mark.ci
def test_labels_lie_on_the_page(drawn: dict[str, Figure]) -> None:
    for name, figure in drawn.items():
        for ax in seen(figure.axes):
            box = ax.get_tightbbox()
            assert box.x0 >= -1, name
            assert box.y0 >= -1, name
            assert box.x1 <= figure.bbox.x1 + 1, name
            assert not ax.axison or ax.get_xlabel() or ax is not figure.axes[-1], name


@pytest.mark.ci
def test_all_figures_over_time_are_shaded_alike(drawn: dict[str, Figure]) -> None:
    for name, figure in drawn.items():
        kind = next((kind for kind in TIMED if name == kind or name.endswith(f"_{kind}")), None)
        both = {"no GNSS fix", "fault of a sensor"} <= set(legend(figure))
        assert both == (kind is not None), name
    for plot in (plot for chapter in CHAPTERS for plot in chapter.plots):  # and their captions say so
        assert plot.timed == (plot.name.removeprefix("{}_") in TIMED)


@pytest.mark.ci
def test_nothing_hides_truth(drawn: dict[str, Figure]) -> None:
    for ax in (*drawn["ground_track"].axes, *drawn["attitude"].axes, drawn["flight"].axes[0]):
        lines = {line.get_label(): line for line in ax.get_lines()}
        others = [lines[name] for name in NAMES]
        assert lines["truth"].get_zorder() > max(line.get_zorder() for line in others)
        assert lines["truth"].get_linewidth() < min(line.get_linewidth() for line in others)
        for above, below in itertools.pairwise(others):
            assert above.get_linewidth() < below.get_linewidth()
            assert above.get_zorder() > below.get_zorder()


def test_no_panel_comes_twice(run: Run) -> None:
    figure = errors.position_errors(run, "dead_reckoning")
    assert figure is not None
    panels = np.array(figure.axes).reshape(3, 2)
    assert [ax.get_visible() for ax in panels[:, 1]] == [True, True, False]  # the height does not drift
    assert panels[1, 1].get_xlabel() == "time [s]"
    for whole, closer in panels[:2]:
        assert whole.get_ylim()[1] > style.FAR * closer.get_ylim()[1]


def test_biases_have_panels_for_the_states_that_there_are() -> None:
    dataset = synthetic_run.dataset(20.0)
    dataset["estimators/ins/sigma_accel_bias"].values[:] = 0.0
    figure = imu.biases(Run(dataset), "ins")
    assert figure is not None
    assert [ax.get_ylabel() for ax in figure.axes] == [f"{axis} [deg/h]" for axis in imu.AXES]
    dataset["estimators/ins/sigma_gyro_bias"].values[:] = np.nan
    assert imu.biases(Run(dataset), "ins") is None


@pytest.mark.ci
def test_ellipses_are_shown_around_the_outage(drawn: dict[str, Figure]) -> None:
    titles = [ax.get_title(loc="left") for ax in seen(drawn["ellipses"].axes)]
    assert titles[0] == "69 s, before the outage"
    assert titles[1] == "78 s, 8 s without fix"
    assert titles[4:] == ["100 s, the end of the outage", "110 s, 10 s after it"]
    beyond = [text.get_text() for text in drawn["ellipses"].axes[3].texts]
    assert len(beyond) == 1
    assert "dead_reckoning" in beyond[0]


def test_an_ellipse_holds_what_it_claims() -> None:
    P = np.array([[4.0, 1.5], [1.5, 1.0]])
    points = consistency.ellipse(P, 3.0)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points, np.linalg.inv(P), points), 9.0)
    assert np.isnan(consistency.ellipse(np.full((2, 2), np.nan), 3.0)).all()


def test_allan_deviation_is_that_of_allantools() -> None:
    rng = np.random.default_rng(3)
    dt, n = 0.01, 20_000
    rate = 0.3 * rng.standard_normal((n, 3)) + np.cumsum(1e-3 * rng.standard_normal((n, 3)), axis=0)
    sizes = np.array([1, 2, 7, 40, 300, 2000])
    found = imu.allan_deviation(rate, dt, sizes)
    for k in range(3):
        _, expected, _, _ = allantools.oadev(rate[:, k], rate=1 / dt, data_type="freq", taus=sizes * dt)
        np.testing.assert_allclose(found[:, k], expected, rtol=1e-9)


def test_density_of_white_noise_is_that_of_its_random_walk() -> None:
    N, dt = 2e-3, 0.005  # rad/sqrt(s)
    rate = N / np.sqrt(dt) * np.random.default_rng(1).standard_normal((200_000, 3))
    frequency, density = imu._density(rate, dt)
    assert frequency[-1] == pytest.approx(100.0)
    np.testing.assert_allclose(np.sqrt(np.mean(density**2, axis=0)), np.sqrt(2) * N, rtol=0.01)


def test_density_is_that_of_scipy() -> None:
    rate = np.random.default_rng(2).standard_normal((9001, 3)).cumsum(axis=0)
    frequency, density = imu._density(rate, 0.005)
    expected, power = welch(rate, 200.0, nperseg=4000, axis=0)
    np.testing.assert_allclose(frequency, expected[1:])
    np.testing.assert_allclose(density**2, power[1:], rtol=1e-9)


def test_allan_needs_rest(run: Run) -> None:
    assert imu.allan(run, "imu") is None
    assert imu.longest(np.array([1, 0, 1, 1, 1, 0, 1], bool)) == slice(2, 5)
    assert imu.longest(np.zeros(3, bool)) == slice(0, 0)


@pytest.mark.parametrize(
    ("low", "high"), [(1.1, 1.4), (0.8, 9.0), (2.1, 4.9), (0.03, 40.0), (1e-6, 1e5), (150.0, 220.0)]
)
def test_a_logarithmic_axis_has_numbers(low: float, high: float) -> None:
    ticks = style._ticks(low, high)
    assert 3 <= len(ticks) <= 12
    assert all(low <= tick <= high for tick in ticks)


def test_a_run_without_estimators_shows_its_flight() -> None:
    run = Run(synthetic_run.dataset(20.0, {}))
    names = [name for chapter in CHAPTERS for _, _, name, _, _ in chapter.drawn(run)]
    assert names[:2] == ["ground_track", "flight"]
    assert flight.wind(run) is None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e308, np.nan])
def test_a_wind_that_is_none_leaves_the_others_to_be_seen(value: float) -> None:
    """Axis limits cannot be NaN or Inf, said the report of an own estimator that had divided by zero."""
    dataset = synthetic_run.dataset(20.0, {"ins": Errors()})
    dataset["estimators/ins/wind"].values[5:8] = value
    figure = flight.wind(Run(dataset))
    assert figure is not None
    figure.canvas.draw()
    for ax in figure.axes:
        low, high = ax.get_ylim()
        assert -20.0 < low < high < 20.0


def test_a_steady_speed_is_shown_as_one() -> None:
    """In calm air the axis was that of its rounding: +2.5e1 over half a millimetre per second."""
    run = Run(synthetic_run.dataset(20.0, {}))
    truth = run.dataset["truth"]
    truth["airspeed"].values[:] = 25.0 + 1e-4 * np.sin(truth["time"].values)
    truth["v_n"].values[:] = [25.0, 0.0, 0.0]
    figure = flight.flight(run)
    figure.canvas.draw()
    speeds = figure.axes[1]
    assert np.ptp(speeds.get_ylim()) >= 2.0
    assert speeds.yaxis.get_major_formatter().get_offset() == ""
