"""The report is written for every kind of run, holds all that it shows, and loses no peak."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from rich.console import Console
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.samples import Outcome
from testbed import Scenario
from testbed import run as simulate
from testbed.errors import UserError
from testbed.record.recorder import Recorder
from testbed.report import campaign_figures, differences, style, tables
from testbed.report import page as report
from testbed.report.figures import consistency, flight, imu
from testbed.report.run import Run
from testbed.results import start_anew
from testbed.score import accuracy, metrics
from testbed.score.differences import Case
from testbed.sensors.faults import FaultTruth

DENIED = ((40.0, 70.0),)
BAD = Errors(drift_mps=300.0)
RUNS: dict[str, dict[str, Any]] = {
    "outage": {"duration_s": 120.0, "estimators": {"ins": Errors(), "dead_reckoning": BAD}, "denied": DENIED},
    "no outage": {"duration_s": 100.0},
    "no gnss": {"duration_s": 100.0, "gnss": False},
    "never aligned": {"duration_s": 20.0, "estimators": {"ins": Errors(aligned_after=1e9)}},
    "short": {"duration_s": 6.0},
    "shortest": {"duration_s": 0.0},
    "turns nan": {"duration_s": 100.0, "estimators": {"ins": Errors(nan_from=80.0)}},
    "no estimator": {"duration_s": 20.0, "estimators": {}},
    "denied to the end": {"duration_s": 100.0, "denied": ((70.0, 1e9),)},
}
AT_ONCE = ("outage", "never aligned", "shortest", "no estimator")  # the others are like them, and take seconds
KINDS = [pytest.param(kind, marks=() if kind in AT_ONCE else pytest.mark.ci) for kind in RUNS]


def printed(found: dict[str, float]) -> str:
    out = io.StringIO()
    Console(file=out, width=160).print(tables.summary(found))
    return out.getvalue()


def body(page: str) -> str:
    """A page without its one script."""
    before, script, rest = page.partition("<script>")
    return before + rest.rpartition("</script>")[2] if script else page


def pictured(images: Iterable[str]) -> list[str]:
    """The figures that a page shows as they are: it has nothing like them to look around in."""
    return [name for name in images if name.endswith(("_allan.png", "_spectra.png")) or name == "visibility.png"]


@pytest.mark.ci
@pytest.mark.parametrize("kind", KINDS)
def test_report_is_written_for_every_kind_of_run(tmp_path: Path, kind: str) -> None:
    run = synthetic_run.dataset(**RUNS[kind])
    found = metrics.compute(run)
    page = report.write_report(run, found, tmp_path)
    text = page.read_text(encoding="utf-8")
    images = sorted(p.name for p in tmp_path.glob("*.png"))
    assert {"flight.png", "ground_track.png"} <= set(images)
    assert body(text).count("data:image/png;base64,") == len(pictured(images))
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", body(text))
    assert "A made-up circle" in text
    assert ("never aligned" in text) == (kind in ("never aligned", "shortest"))
    assert printed(found)
    if kind == "outage":
        for name in ("ins", "dead_reckoning"):
            for what in ("position_errors", "motion_errors", "biases", "innovations"):
                assert f"{name}_{what}.png" in images
        assert {"comparison.png", "attitude.png", "wind.png", "nees.png"} <= set(images)
    start_anew(tmp_path)
    assert not list(tmp_path.iterdir()), "the next run would leave it there"


@pytest.mark.ci
def test_a_figure_that_is_not_ours_is_not_replaced(tmp_path: Path) -> None:
    run = synthetic_run.dataset(**RUNS["no gnss"])
    (tmp_path / "flight.png").write_text("mine")
    with pytest.raises(UserError, match=r"flight\.png already, not made by an earlier command"):
        report.write_report(run, {}, tmp_path)
    assert (tmp_path / "flight.png").read_text() == "mine"
    report.write_report(run, {}, tmp_path, force=True)
    assert (tmp_path / "flight.png").stat().st_size > 1000


@pytest.mark.ci
def test_a_body_at_rest(tmp_path: Path) -> None:
    recorder = Recorder(None, scenario(100.0), 1)
    truth = circle(100.0)
    for name in ("lat", "lon", "h"):
        getattr(truth, name)[:] = getattr(truth, name)[0]
    truth.v_n[:] = 0.0
    truth.airspeed[:] = 0.0
    synthetic_run.record(recorder, truth, {"ins": Errors()})
    page = report.write_report(recorder.dataset(), {}, tmp_path)
    images = {path.name for path in tmp_path.glob("*.png")}
    assert {"flight.png", "ground_track.png", "ins_position_errors.png"} <= images
    assert body(page.read_text(encoding="utf-8")).count("data:image/png;base64,") == len(pictured(images))
    assert "imu_allan.png" in pictured(images)


@pytest.mark.ci
def test_faults_are_shaded_and_their_detection_is_told(tmp_path: Path) -> None:
    recorder = Recorder(None, scenario(120.0), 1)
    named = {"jump": ("gnss", 80.0), "rise": ("barometer", 85.0), "unseen": ("airspeed", 70.0)}
    recorder.faults([FaultTruth(n, s, "x", "step", t, t + 20, 3.0, "m") for n, (s, t) in named.items()])
    synthetic_run.record(recorder, circle(120.0), {"ins": Errors(aligned_after=0.0)})
    run = recorder.dataset()
    for aid, weight in (("gnss_position", 0.0), ("barometer", 1.0)):
        reports = run[f"estimators/ins/innovations/{aid}"]
        t = reports["sample_time"].values
        reports["weight"].values[(t > 82 - 1e-6) & (t < 105)] = weight
    found = metrics.compute(run)
    page = report.write_report(run, found, tmp_path).read_text()
    rows = re.findall(r"<tr><td>(.*?)</td></tr>", page)
    cells = {row.partition(":")[0]: row.split("</td><td>")[1:] for row in rows if ": " in row}
    ratio = {name: f"{found[f'ins.error_over_3sigma.{name}']:.2g}" for name in ("jump", "rise")}
    # Velocity was used all the time, position was not.
    assert cells["jump"] == ["ins", "2.0", "90 %", "5.0", "yes", ratio["jump"]]
    assert cells["rise"] == ["ins", "missed", "0 %", "0.0", "no", ratio["rise"]]
    assert cells["unseen"][0] == "none looked"
    assert "gnss x step 3 m, 80 to 100 s" in page
    table = tables.fault_table(found)
    out = io.StringIO()
    Console(file=out, width=160).print(table)
    assert re.search(r"jump\W+ins\W+2\.0\W+90 %", out.getvalue())
    assert "detected after [s]" in out.getvalue()
    Console(file=out, width=160).print(tables.fault_table(found | {"ins.coverage.jump": 0.00222}))
    assert "0.222 %" in out.getvalue()  # little is not nothing
    assert tables.fault_table({"ins.position_horizontal_rms_m": 1.0}) is None
    figure = consistency.innovations(Run(run), "ins")
    assert figure is not None
    shaded = [
        ax.get_title(loc="left").partition(":")[0]
        for ax in figure.axes
        for patch in ax.patches
        if to_hex(patch.get_facecolor()).upper() == style.FAULT
    ]
    assert shaded == ["gnss_position", "gnss_velocity", "barometer"]


def test_refused_innovations_have_the_colour_of_their_outcome() -> None:
    run = synthetic_run.dataset(120.0, {"ins": Errors(aligned_after=0.0)})
    reports = run["estimators/ins/innovations/barometer"]
    t = reports["sample_time"].values
    spans = {
        Outcome.OUTSIDE_GATE: (20.0, 30.0),
        Outcome.ISOLATED: (30.0, 50.0),
        Outcome.WITHHELD: (50.0, 52.0),
        Outcome.UNSOUND: (60.0, 61.0),
        Outcome.FUSED: (70.0, 70.5),  # at weight 0
    }
    for outcome, (start, end) in spans.items():
        rows = (t >= start) & (t < end)
        reports["outcome"].values[rows], reports["weight"].values[rows] = outcome, 0.0
        if outcome is Outcome.UNSOUND:
            reports["innovation"].values[rows] = np.nan
    figure = consistency.innovations(Run(run), "ins")
    assert figure is not None
    panel = next(ax for ax in figure.axes if ax.get_title(loc="left").startswith("barometer"))
    crosses = {line.get_color(): line for line in panel.lines if line.get_marker() == "x" and len(line.get_xdata())}
    assert len(crosses) == len(spans)
    for outcome, (start, end) in spans.items():
        line = crosses[style.NOT_USED[Outcome.WEAKENED if outcome is Outcome.FUSED else outcome]]
        np.testing.assert_array_equal(line.get_xdata(), t[(t >= start) & (t < end)])
        assert np.isfinite(line.get_ydata()).all()
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert told[:4] == [
        "gate",
        "outside the gate",
        "sensor isolated",
        "withheld: probation, attitude lost, or refused with another part",
    ]
    assert "out of range" not in told


@pytest.mark.ci
def test_broken_increments_leave_the_rest_of_the_bias_figure() -> None:
    run = synthetic_run.dataset(300.0)
    clean = imu.imu_error(Run(run), "ins")
    increments = run["sensors/imu/dtheta"].values
    increments[200 * 100 : 200 * 100 + 3] = [[np.nan] * 3, [np.inf, 0, 0], [1e300, 0, 0]]
    broken = imu.imu_error(Run(run), "ins")
    assert clean is not None
    assert broken is not None
    apart = np.abs(broken["t"] - 100.0) > 31
    np.testing.assert_allclose(broken["gyro"][apart], clean["gyro"][apart], atol=1e-9)
    assert np.isnan(broken["gyro"][np.abs(broken["t"] - 100.0) < 29]).all()


def test_the_errors_of_a_unit_are_of_body_axes_however_it_is_mounted() -> None:
    """Of one that is turned by 90 deg they were thousands of deg/h."""
    mounted = {"sensors.imu.grade": "perfect", "sensors.imu.mounting_deg": [0.0, 10.0, 90.0]}
    keys = {"duration_s": 250, "truth.segments[0].duration_s": 100, "expect": {}}
    flown = simulate(Scenario.load("kinematic_u_flight", keys | mounted))
    found = imu.imu_error(Run(flown.dataset), "ins")
    assert found is not None
    assert abs(found["gyro"]).max() < 1e-7
    assert abs(found["accel"]).max() < 1e-4


def test_table_sets_gnss_and_outage_side_by_side() -> None:
    found = metrics.compute(synthetic_run.dataset(**RUNS["outage"])) | {"run.wall_s": 2.0, "run.realtime_factor": 60.0}
    text = printed(found)
    assert "horizontal position error, RMS [m]" in text
    assert "60 times real time" in text
    row = next(line for line in text.splitlines() if "horizontal position error, largest" in line)
    cells = [float(c) for c in row.split("│")[2:6]]
    keys = [f"{n}.{p}position_horizontal_max_m" for n in ("ins", "dead_reckoning") for p in ("", "outage_")]
    np.testing.assert_allclose(cells, [found[key] for key in keys], rtol=0.01)


def test_an_interrupted_run_says_so(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.nc", scenario(60.0), 1)
    recorder.truth(circle(20.0))
    text = report.write_report(recorder.dataset(), {}, tmp_path).read_text(encoding="utf-8")
    recorder.close()
    assert "did not end" in text


def test_thinning_keeps_every_peak_and_every_gap() -> None:
    t = np.arange(100_000.0)
    y = np.random.default_rng(0).normal(size=t.size)
    y[12_345], y[77_777] = 50.0, -50.0
    y[40_000:50_000] = np.nan
    t_thin, y_thin = style.thin(t, y)
    assert len(t_thin) <= 2.2 * style.BINS
    assert (np.diff(t_thin) >= 0).all()
    assert {12_345.0, 77_777.0} <= set(t_thin)
    inside = (t_thin > 40_200) & (t_thin < 49_800)
    assert inside.any()
    assert np.isnan(y_thin[inside]).all()
    np.testing.assert_array_equal(y_thin, y[t_thin.astype(int)])


def test_scenario_text_cannot_break_the_page(tmp_path: Path) -> None:
    recorder = Recorder(None, scenario(5.0), 1)
    recorder.truth(circle(5.0))
    recorder.event(1.0, "info", "</table><script>alert(1)</script>")
    text = report.write_report(recorder.dataset(), {}, tmp_path).read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert text.count("<script") == text.count("</script") == 1


def test_unwritable_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="can't be written"):
        report.write_report(synthetic_run.dataset(5.0), {}, tmp_path / "file")


def test_tables_turn_over_where_they_do_not_fit() -> None:
    names = ("ins", "dead_reckoning", "federated_with_a_long_name", "ahrs")
    found = {
        f"{name}.{prefix}{key}": 1234.5 + k
        for k, name in enumerate(names)
        for prefix in ("", "outage_")
        for key, _ in tables.ROWS
    }
    found |= {f"{name}.{key}.pitot_blocked_again": 1.0 for name in names for key in ("missed", "isolation_correct")}

    def shown(what: object, width: int) -> list[str]:
        out = io.StringIO()
        Console(file=out, width=width).print(what)
        assert "…" not in out.getvalue()
        return out.getvalue().splitlines()

    for what in (tables.summary(found), tables.fault_table(found)):
        wide, narrow = shown(what, 250), shown(what, 80)
        assert (sum("┏" in line for line in wide), sum("┏" in line for line in narrow)) == (1, len(names))
        assert max(map(len, narrow)) <= 80
        numbers = [re.findall(r"1\.23e\+03|1\.24e\+03|yes", "\n".join(lines)) for lines in (wide, narrow)]
        assert sorted(numbers[0]) == sorted(numbers[1]) != []


def test_page_fits_a_phone_has_contents_and_is_the_same_again(tmp_path: Path) -> None:
    recorder = Recorder(None, scenario(5.0), 1)
    recorder.truth(circle(5.0))
    recorder.event(1.0, "info", "something")
    pages = [report.write_report(recorder.dataset(), {}, tmp_path / name).read_text("utf-8") for name in "ab"]
    assert pages[0] == pages[1]
    pages = [body(page) for page in pages]
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in pages[0]
    targets = re.findall(r'href="#([^"]+)"', pages[0])
    assert targets == ["map", "flight", "events", "record"]
    assert all(f'id="{target}"' in pages[0] for target in targets)
    assert pages[0].count('<div class="wide"><table') == pages[0].count("<table") > 0


def test_whiskers_are_where_the_caption_says() -> None:
    axes = Figure().subplots()
    errors = np.random.default_rng(0).gamma(2.0, size=7).tolist()
    campaign_figures._boxes(axes, [errors, []], "#123456")
    ends = [line.get_ydata() for line in axes.get_lines() if len(line.get_ydata()) == 2]
    assert {np.percentile(errors, 5), np.percentile(errors, 95)} <= {float(y) for own in ends for y in own}


def test_a_page_tells_which_estimator_is_better_than_the_first() -> None:
    worse, better = "position_horizontal_rms_m", "heading_rms_deg"
    found = {f"ins.{worse}": 1.0, f"other.{worse}": 3.0, f"ins.{better}": 2.0, f"other.{better}": 1.0}
    case = Case("", ["ins", "other"], [(0, found)])
    ((block, rows),) = differences.with_cells(differences.blocks([case]))
    assert block.head[1:3] == ("ins", "other")
    assert (block.count("better"), block.count("worse")) == (1, 1)
    assert [cells[3:5] for _, cells in rows] == [["+200.0 %", "worse"], ["-50.0 %", "better"]]
    assert block.note == differences.ALONE


def test_a_page_begins_with_who_has_ended_and_says_no_verdict() -> None:
    run = synthetic_run.dataset(20.0, {"ins": Errors(), "dead_reckoning": Errors()})
    run.attrs["ended"] = json.dumps({"dead_reckoning": "RuntimeError: lost [its] way"})
    metric = "position_horizontal_rms_m"
    found = report.content(Run(run), {f"ins.{metric}": 3.0, f"dead_reckoning.{metric}": 1.0})
    assert found["remarks"][0] == "dead_reckoning has ended: RuntimeError: lost [its] way"
    ((block, rows),) = found["against"]
    assert [cells[4] for _, cells in rows] == ["none"]
    assert block.note == (
        "No verdict, as not all of the run is scored: dead_reckoning has ended: RuntimeError: lost [its] way."
    )
    assert "dead_reckoning against ins: no verdict</summary>" in report.render("run.html", figures=[], **found)


def test_estimators_are_in_the_order_of_the_scenario_whoever_speaks_first() -> None:
    """So that a report has the colours that the run had."""
    run = synthetic_run.dataset(20.0, {"second": Errors(), "first": Errors()})
    run.attrs["estimator_imus"] = json.dumps({"first": "imu", "second": "imu"})
    assert accuracy.names(run) == ["first", "second"]


@pytest.mark.ci
@pytest.mark.parametrize(("grown", "unit"), [(10.0, "km"), (1.0, "m")])
def test_a_short_track_is_in_metres(grown: float, unit: str) -> None:
    run = synthetic_run.dataset(120.0, {"ins": Errors(aligned_after=0.0)})
    for group in ("truth", "estimators/ins"):
        for axis in ("lat", "lon"):
            own = run[group][axis].values
            own[:] = own[0] + grown * (own - own[0])
    figure = flight.ground_track(Run(run))
    assert figure is not None
    ax = figure.axes[0]
    assert ax.get_xlabel().endswith(f"[{unit}]")
    assert ax.get_ylabel().endswith(f"[{unit}]")
    assert unit == "km" or ax.xaxis.get_major_formatter()(0.5, 0) == "500"


def test_the_track_is_grey_where_a_reference_is_silent() -> None:
    """That of a log goes with the fixes: the legend told of grey that was nowhere."""
    run = synthetic_run.dataset(100.0, {"ins": Errors()}, denied=((40.0, 60.0),))
    inside = (run["truth/time"].values > 40.0) & (run["truth/time"].values < 60.0)
    for axis in ("lat", "lon", "h"):
        run[f"truth/{axis}"].values[inside] = np.nan
    figure = flight.ground_track(Run(run))
    assert "no GNSS fix" in labels(figure)
    [grey] = [line for line in figure.axes[0].lines if line.get_color() == style.SHADE]
    places = np.column_stack(grey.get_data())
    known = np.isfinite(places).all(axis=1)
    assert known.sum() >= inside.sum()
    steps = np.diff(places[known], axis=0)[1:-1]
    np.testing.assert_allclose(steps, np.tile(steps.mean(axis=0), (len(steps), 1)), atol=1e-3)  # [km]


def labels(figure: Figure | None) -> set[str]:
    """What the legend of a figure names."""
    assert figure is not None
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}


@pytest.mark.parametrize("recorded", [False, True])
def test_a_legend_names_no_line_that_is_not_there(recorded: bool) -> None:
    """Of a recorded flight airspeed and increments are known to nobody, and speed is the reference's."""
    dataset = synthetic_run.dataset(120.0, {"ins": Errors(aligned_after=0.0)})
    if recorded:
        dataset.attrs["reference"] = "reference of the log"
        dataset["truth/airspeed"].values[:] = np.nan
        for name in ("dtheta", "dv"):
            dataset[f"truth/{name}"].values[:] = 0.0
    run = Run(dataset)
    flown, spectra = labels(flight.flight(run)), labels(imu.spectra(run, "imu"))
    assert "measured" in spectra
    assert ("truth, up to half the rate of the record" in spectra) != recorded
    assert ("true airspeed" in flown) != recorded
    assert ("true speed over ground" in flown) != recorded
    assert ("speed over ground of the reference" in flown) == recorded
