"""Wrong scenarios: every mistake is one clear message with file, line, key and advice; nothing else ever comes out."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from testbed import sensors
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.estimators.datasheet import aid_of
from testbed.loop.loop import run
from testbed.scenario import Scenario, expected
from testbed.sensors import registry
from testbed.sensors.faults import Faults

TEXTS = {path.stem: path.read_text("utf-8") for path in sorted(data_dir("scenarios").glob("*.toml"))}
U_TURN = TEXTS["u_turn"]
FAULTY = """
[[fault]]
sensor = "gnss"
channel = "position"
kind = "ramp"
window = [50, 80]
slope = 2.0
unit = "sigma"
bearing_deg = 30
[[fault]]
name = "blocked"
sensor = "airspeed"
channel = "speed"
kind = "stuck"
window = [60, 90]
value = 5.0
[[fault]]
sensor = "gnss"
kind = "drag_off"
window = [60, 90]
bearing_deg = 90
acceleration_mps2 = 0.1
"""


def complaint(text: str, *overrides: str) -> str:
    with pytest.raises(UserError) as caught:
        Scenario.parse(text, overrides, Path("mine.toml"))
    return str(caught.value)


def line_of(text: str, start: str) -> int:
    """Number of the first line that begins with ``start``."""
    return next(n for n, line in enumerate(text.splitlines(), 1) if line.startswith(start))


# --- one mistake in the file: what is replaced, on which line the message is to point, and what it says


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('title = "A', 'titel = "A', "titel: unknown key: did you mean title? Choose from title, seed"),
        ("seed = 1", "seed = 1.5", "seed: must be a whole number, not 1.5"),
        ("seed = 1", "seed = -1", "seed: must be greater than or equal to 0, not -1"),
        ("duration_s = 200", "duration_s = 0", "duration_s: must be greater than 0, not 0"),
        ("duration_s = 200", "duration_s = 1e9", "duration_s: must be less than or equal to 172800"),
        ("duration_s = 200", "duration_s = nan", "duration_s: must be a finite number, not nan"),
        ("duration_s = 200", "duration_s = inf", "duration_s: must be a finite number, not inf"),
        ("duration_s = 200", 'duration_s = "200"', 'duration_s: must be a number, not "200"'),
        ("duration_s = 200", "duration_min = 4", "duration_min: unknown key: did you mean duration_s"),
        ("date = 2026-06-01", "date = 2026", "date: must be a date such as 2026-06-01, not 2026"),
        (
            "date = 2026-06-01",
            "date = 2035-06-01",
            "date: there is no geomagnetic model for 2035-06-01: choose one from 2010 to 2029, as the World",
        ),
        ('source = "flight"', 'source = "fly"', 'truth.source: there is no source "fly": '),
        ('source = "flight"', "", "truth.source: is missing: add it, one of flight, kinematic"),
        ('aircraft = "loiter"', 'aircraft = "loitr"', 'truth.aircraft: there is no aircraft "loitr": did you mean'),
        ("start = { lat_deg = 47.0", "start = { lat_deg = 85.0", "truth.start.lat_deg: must be less than 85, not 85"),
        (
            "start = { lat_deg = 47.0",
            "start = { lat_rad = 0.7",
            "truth.start.lat_rad: unknown key: did you mean lat_deg",
        ),
        ("start = { lat_deg = 47.0,", "start = {", "truth.start.lat_deg: is missing: add it"),
        ("wind = {", "wind = 5 # {", "truth.wind: must be a table, not 5"),
        ('leg = "u_turn"', 'leg = "uturn"', 'plan[1].leg: there is no leg "uturn": did you mean u_turn'),
        ('leg = "u_turn"', "", "plan[1].leg: is missing: add it, one of straight"),
        ('direction = "left"', 'direction = "lift"', 'plan[1].direction: can\'t be "lift": did you mean left'),
        ("[sensors.gnss]", "[sensors.gns]", 'sensors.gns: there is no sensor of kind "gns": did you mean gnss'),
        ("[sensors.gnss]", "[sensors.2nd]", 'sensors.2nd: there is no sensor of kind "2nd": choose from '),
        ("[sensors.gnss]", '[sensors."a/b"]\nkind = "gnss"', 'sensors."a/b": a sensor\'s name is made of letters'),
        ("[sensors.imu]", "[sensors.imu]\ngrade_ = 3", "sensors.imu.grade_: unknown key: did you mean grade"),
        ('grade = "mems-industrial"', 'grade = "mems-industrail"', "sensors.imu.grade: can't be"),
        ("[sensors.gnss]", "[sensors.dvl]", 'sensors.dvl: there is no sensor of kind "dvl": choose from '),
        (
            "[sensors.gnss]",
            "[sensors.body_velocity]\naxes = []\n[sensors.gnss]",
            "sensors.body_velocity.axes: must name each measured axis once",
        ),
        (
            "[sensors.gnss]",
            "[sensors.star_tracker]\nboresight = 'up'\n[sensors.gnss]",
            'sensors.star_tracker.boresight: can\'t be "up": choose from forward, right, down',
        ),
        (
            "[sensors.gnss]",
            "[sensors.position_fix]\ntransponder = { lat_deg = 47.0, lon_deg = 8.0 }\n[sensors.gnss]",
            "sensors.position_fix.transponder.range_m: is missing: add it",
        ),
        ('name = "ins"', 'name = "my ins"', "estimator[0].name: is made of letters"),
        ('name = "ins"', 'name = "run"', "estimator[0].name: 'run' is reserved"),
        ('kind = "ins"', 'kind = "ukf"', 'estimator[0].kind: there is no kind "ukf": choose from ins'),
        ('kind = "ins"', 'imu = "gnss"', 'estimator[0].imu: there is no IMU "gnss": choose from imu'),
        ('aids = ["gnss", ', 'aids = ["gps", ', 'estimator[0].aids[0]: there is no sensor "gps"'),
        (
            'aids = ["gnss", ',
            'aids = ["imu", ',
            "estimator[0].aids[0]: 'imu' is of kind 'imu', which does not aid 'ins'",
        ),
        ('aids = ["gnss", "b', 'aids = ["gnss", "gnss", "b', "estimator[0].aids[1]: 'gnss' is listed twice"),
        ("[expect]", "[expect]\nposition_rms_m = 3", "expect.position_rms_m: is no metric: write it quoted as"),
        ("[expect]", '[expect]\n"inz.position_rms_m" = 3', 'expect."inz.position_rms_m": there is no estimator "inz"'),
        (
            "[expect]",
            '[expect]\n"ins.heading_rms" = 3',
            'expect."ins.heading_rms": there is no metric "heading_rms": did you mean heading_rms_deg?',
        ),
        ("[expect]", '[expect]\n"ins.nis_mean" = 3', "did you mean nis_mean.<aid>?"),
        (
            "[expect]",
            '[expect]\n"ins.nis_mean.gnss_pos" = 3',
            'there is no aid of ins "gnss_pos": did you mean gnss_position?',
        ),
        (
            "[expect]",
            '[expect]\n"ins.nis_mean.range" = 3',
            'there is no aid of ins "range": choose from gnss_position, gnss_v',
        ),
        ("[expect]", '[expect]\n"ins.missed.magy" = 3', 'there is no fault "magy": there is none to choose from'),
        ("[expect]", '[expect]\n"run.wall" = 3', 'there is no metric "wall": did you mean wall_s?'),
        ("[expect]", "[expect]\nins.roll_rms_deg = 3", "expect.ins: takes a maximum, or min and max; a metric's name"),
        ("[expect]", '[expect]\n"ins.x_m" = {}', 'expect."ins.x_m": give a maximum'),
        ("[expect]", '[expect]\n"ins.x_m" = {min = 2, max = 1}', 'expect."ins.x_m": min 2 is above max 1'),
        (
            "[expect]",
            '[autopilot]\nfeedback = "inz"\n[expect]',
            'autopilot.feedback: there is no estimator "inz": did you mean ins? Choose from ins, truth',
        ),
        (
            "[expect]",
            '[autopilot]\nfeedback = { attitude = "ins", position = "gps" }\n[expect]',
            'autopilot.feedback.position: there is no estimator "gps": choose from ins, truth',
        ),
        (
            "[expect]",
            '[autopilot]\nfeedback = { altitude = "ins" }\n[expect]',
            "autopilot.feedback.altitude: unknown key: did you mean attitude? Choose from attitude, position",
        ),
        (
            "[expect]",
            "[autopilot]\nfeedback = 3\n[expect]",
            "autopilot.feedback: must be an estimator's name, or a table of",
        ),
        ("[expect]", '[expect]\n"flights.bank_max_deg" = 3', 'there is no estimator "flights": did you mean flight?'),
        (
            "[expect]",
            "[record]\nrate_hz = 30\n[expect]",
            "record.rate_hz: 30 Hz does not divide the tick rate of 200 Hz",
        ),
        ("[expect]", "[record]\nimu = 1\n[expect]", "record.imu: must be true or false, not 1"),
    ],
)
def test_one_mistake_one_message(old: str, new: str, says: str) -> None:
    text = U_TURN.replace(old, new, 1)
    assert text != U_TURN
    message = complaint(text)
    assert says in message
    at = next(line for line in message.splitlines() if says in line)
    line = int(re.match(r"mine\.toml:(\d+): ", at)[1])  # type: ignore[index]
    changed = [n for n, (a, b) in enumerate(zip(text.splitlines(), U_TURN.splitlines(), strict=False), 1) if a != b]
    assert changed[0] - 1 <= line <= changed[0] + 2


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('title = "A', 'title = "A"', "mine.toml:5: is not valid TOML"),
        ("seed = 1", "seed = 1\nseed = 2", "mine.toml:7: is not valid TOML"),
        ("[[plan]]", "[[plan]", "mine.toml:17: is not valid TOML"),
        ("seed = 1", "seed = " + "9" * 5000, "mine.toml: is not valid TOML"),
        ("seed = 1", "seed = " + "[" * 5000 + "]" * 5000, "mine.toml: tables or lists are nested too deeply"),
    ],
)
def test_text_that_is_not_toml(old: str, new: str, says: str) -> None:
    assert complaint(U_TURN.replace(old, new, 1)).startswith(says)


@pytest.mark.parametrize(
    ("windows", "says"),
    [
        ("[[80, 50]]", "denied: window [80, 50] ends before it starts"),
        ("[[80, 80]]", "denied: window [80, 80] ends before it starts"),
        ("[[-5, 20]]", "denied: window [-5, 20] starts before the run"),
        ("[[50, 80], [70, 90]]", "denied: windows [50, 80] and [70, 90] overlap"),
        ("[[50, 90], [60, 70]]", "denied: windows [50, 90] and [60, 70] overlap"),
        ("[[250, 300]]", "denied: window [250, 300] starts after the end of the run: duration_s is 200"),
        ("[[50]]", "denied[0][1]: is missing: this item needs one more value"),
        ("[[50, 60, 70]]", "denied[0]: has 3 items, but at most 2 are allowed"),
        ('[["50", 60]]', 'denied[0][0]: must be a number, not "50"'),
        ("[50, 60]", "denied[0]: must be a list, not 50"),
        ("3", "denied: must be a list, not 3"),
    ],
)
def test_windows(windows: str, says: str) -> None:
    message = complaint(U_TURN.replace("[sensors.gnss]", f"[sensors.gnss]\ndenied = {windows}"))
    assert message.startswith(f"mine.toml:{line_of(U_TURN, '[sensors.gnss]') + 1}: sensors.gnss.{says}")


def test_a_front_that_never_comes() -> None:
    front = "front = { time_s = 230, width_s = 20, from_deg = 300, speed_mps = 9 }"
    text = U_TURN.replace("wind = {", "wind = { " + front + ",")
    assert "truth.wind.front.time_s: it comes after the end of the run: duration_s is 200" in complaint(text)
    assert Scenario.parse(text.replace("width_s = 20", "width_s = 80"))


STEP = {"sensor": "gnss", "channel": "north", "kind": "step", "window": [50, 60], "size": 5.0}


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"sensor": "gns"}, 'sensor: there is no sensor "gns": did you mean gnss'),
        ({"channel": "nort"}, 'channel: there is no channel of gnss "nort": did you mean north'),
        ({"sensor": "imu"}, 'channel: there is no channel of imu "north": choose from gyro_x, gyro_y'),
        ({"kind": "stp"}, 'kind: there is no kind "stp": did you mean step'),
        ({"kind": None}, "kind: is missing: add it, one of step, ramp"),
        ({"window": [60, 50]}, "window: [60, 50] ends before it starts"),
        ({"window": [-5, 50]}, "window: [-5, 50] starts before the run"),
        ({"window": [200, 250]}, "window: [200, 250] starts after the end of the run: duration_s is 200"),
        ({"window": [50]}, "window[1]: is missing: this item needs one more value"),
        ({"size": None}, "size: is missing: add it"),
        ({"size": "5"}, 'size: must be a number, not "5"'),
        ({"size": 1e300}, "size: must be less than or equal to"),
        ({"slope": 5.0}, "slope: unknown key: choose from name, sensor, window, channel, bearing_deg"),
        ({"kind": "ramp"}, "slope: is missing: add it"),
        ({"unit": "m/s"}, "unit: 'm/s' does not fit gnss north: choose from m, sigma"),
        ({"bearing_deg": 30.0}, "bearing_deg: 'north' has its own direction"),
        ({"channel": "position"}, "channel: 'position' has no direction of its own: add bearing_deg"),
        ({"channel": "position", "bearing_deg": 400.0}, "bearing_deg: must be less than or equal to 360"),
        ({"kind": "scale", "size": None, "factor": 2.0}, "kind: a multiple of 'north' means nothing"),
        ({"kind": "stuck", "size": None, "value": 2.0}, "value: 'north' takes no value"),
        ({"kind": "noise", "size": None, "factor": 0.5}, "factor: must be greater than or equal to 1, not 0.5"),
        ({"kind": "sine", "period_s": 0.0}, "period_s: must be greater than or equal to 0.001"),
        ({"kind": "dropout", "size": None}, "channel: a sample of kind 'gnss' is lost as a whole"),
        ({"kind": "slow", "size": None, "channel": None, "factor": 1}, "factor: must be greater than or equal to 2"),
        ({"kind": "slow", "size": None, "channel": None, "factor": 5, "sensor": "imu"}, "channel: is missing: gyros"),
        ({"channel": "fix"}, "channel: 'fix' stands for several of different units: name one of them"),
        ({"channel": "gyro", "sensor": "imu", "kind": "noise", "factor": 2.0, "size": None},
         "channel: 'gyro' stands for several, whose noise is not the same: name one of them"),
        (
            {"sensor": "airspeed", "channel": "speed", "kind": "stuck", "size": None, "unit": "sigma", "value": 3.0},
            "unit: a value is in no sigmas: give it in m/s",
        ),
        (
            {"sensor": "barometer", "kind": "drag_off", "bearing_deg": 3.0, "velocity_mps": 1.0, "size": None,
             "channel": None},
            "kind: drag_off needs a sensor of position, and 'barometer' is of kind 'barometer'",
        ),
        ({"kind": "drag_off", "bearing_deg": 3.0, "size": None, "channel": None}, "kind: drag_off needs velocity_mps"),
        ({"name": "a b"}, "name: is made of letters, digits and _"),
        ({"name": "x" * 65}, "name: String should have at most 64 characters"),
    ],
)  # fmt: skip
def test_faults(keys: dict[str, Any], says: str) -> None:
    fault = {key: value for key, value in (STEP | keys).items() if value is not None}
    text = U_TURN + "\n[[fault]]\n" + "".join(f"{key} = {toml(value)}\n" for key, value in fault.items())
    message = complaint(text)
    assert f"fault[0].{says}" in message
    line = int(re.match(r"mine\.toml:(\d+): ", message.splitlines()[0])[1])  # type: ignore[index]
    assert line >= line_of(text, "[[fault]]")


def test_a_sigma_needs_a_sensor_that_states_one() -> None:
    text = U_TURN + "\n[[fault]]\n" + "".join(f"{key} = {toml(value)}\n" for key, value in STEP.items())
    perfect = "sensors.gnss.grade=perfect"
    says = "'gnss' states no error of 'north' to take multiples of: give a size"
    assert f"fault[0].unit: {says}" in complaint(text + 'unit = "sigma"\n', perfect)
    noise = text.replace('kind = "step"', 'kind = "noise"').replace("size = 5.0", "factor = 5.0")
    assert f"fault[0].factor: {says}" in complaint(noise, perfect)


def test_faults_of_one_name() -> None:
    fault = "\n[[fault]]\n" + "".join(f"{key} = {toml(value)}\n" for key, value in STEP.items())
    assert len(Scenario.parse(U_TURN + 3 * fault).fault) == 3
    text = U_TURN + fault + fault + 'name = "gnss_north_step"\n'
    assert "fault[1].name: 'gnss_north_step' is taken by a fault above" in complaint(text)


def test_a_misspelt_key_is_not_missing_as_well() -> None:
    assert len(complaint(U_TURN.replace("lat_deg", "latt_deg")).splitlines()) == 1
    assert len(complaint(U_TURN.replace("lat_deg", "bogus")).splitlines()) == 2


def test_a_window_may_reach_beyond_the_end() -> None:
    assert Scenario.parse(U_TURN, ["sensors.gnss.denied=[[150, 400]]"]).sensors["gnss"].denied == ((150.0, 400.0),)


def test_rates_divide_the_tick_and_offsets_are_whole_ticks() -> None:
    message = complaint(
        U_TURN, "sensors.barometer.rate_hz=60", "sensors.imu.rate_hz=400", "sensors.gnss.offset_s=0.012"
    )
    assert "sensors.barometer.rate_hz: 60 Hz does not divide the tick rate of 200 Hz" in message
    assert "try 50 or 66.66666667" in message
    assert "sensors.imu.rate_hz: 400 Hz is faster than the tick rate of 200 Hz" in message
    assert "sensors.gnss.offset_s: is not a multiple of the tick 0.005 s: the nearest is 0.01" in message
    assert "less than once in the longest run" in complaint(U_TURN, "sensors.gnss.rate_hz=1e-320")
    Scenario.parse(U_TURN, ["sensors.barometer.rate_hz=66.66666667", "sensors.gnss.offset_s=0.015"])


def test_all_mistakes_in_one_go_in_order_of_lines() -> None:
    text = U_TURN.replace("seed = 1", "seed = true").replace("lat_deg = 47.0", "lat_deg = 91")
    message = complaint(text.replace("direction", "direktion"), "sensors.imu.rate_hz=fast")
    assert [line.split(": ")[1] for line in message.splitlines() if "--set" not in line] == [
        "seed",
        "truth.start.lat_deg",
        "plan[1].direktion",
    ]
    assert 'mine.toml (--set sensors.imu.rate_hz=fast): sensors.imu.rate_hz: must be a number, not "fast"' in message


def test_a_flood_of_mistakes_is_cut_short() -> None:
    message = complaint("\n".join(f"x{i} = 1" for i in range(100)))
    assert len(message.splitlines()) == 21
    assert message.endswith("and 83 more")  # 100 unknown and 3 missing keys


def test_same_name_for_two_estimators() -> None:
    second = U_TURN[U_TURN.index("[[estimator]]") : U_TURN.index("[expect]")]
    message = complaint(U_TURN.replace("[expect]", f"{second}[expect]"))
    assert "estimator[1].name: 'ins' is taken by an estimator above" in message


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("estimator[0].locals=[]", "estimator[0].locals: is missing: add local filters, such as"),
        ('estimator[0].locals[0].name="air"', "estimator[0].locals[1].name: 'air' is taken by a local filter above"),
        ('estimator[0].locals[0].name="1"', "estimator[0].locals[0].name: is made of letters, digits and _"),
        ('estimator[0].locals[1].aids=["gps"]', 'estimator[0].locals[1].aids[0]: there is no sensor "gps"'),
        ('estimator[0].locals[1].aids=["imu"]', "aids[0]: 'imu' is of kind 'imu', which does not aid 'federated'"),
        ("estimator[0].locals[1].share=0.4", "estimator[0].locals: the shares of all local filters must add up to 1"),
        (
            'estimator[0].aids=["gnss"]',
            "estimator[0].aids: is a key of kind 'ins' or 'ahrs', not of 'federated': give it to its locals",
        ),
        (
            "estimator[0]={name='ins', kind='federated', cross_check=true, structure='partial', "
            "locals=[{name='a', aids=['gnss']}]}",
            "compares independent filters",
        ),
        ('estimator[0].combination="scalar"', "combination 'scalar' needs no shares: set sharing = \"none\""),
        ('estimator[0].structure="no_rest"', 'can\'t be "no_rest": did you mean no_reset?'),
        ('estimator[0].locals[0].detector={kind="gl"}', 'detector.kind: can\'t be "gl": did you mean glr?'),
        (
            'estimator[0].locals[0].detector={kind="glr", reset="fast"}',
            "estimator[0].locals[0].detector: reset is a key of kind 'sprt', not of 'glr': leave it out",
        ),
        (
            'estimator[0].locals[0].detector={kind="eraim", window_s=5.0}',
            "estimator[0].locals[0].detector: window_s is a key of kind 'glr' or 'sprt', not of 'eraim': leave it out",
        ),
        (
            'estimator[0].locals[0].detector={kind="sprt", window_s=5.0}',
            "estimator[0].locals[0].detector: window_s is a key of mean 'window', not of 'exponential': leave it out",
        ),
        (
            'estimator[0].locals[0].detector={kind="sprt", mean="plain", forgetting=0.9}',
            "locals[0].detector: forgetting is a key of mean 'exponential', not of 'plain': leave it out",
        ),
        ('estimator[0].locals[0].detector.mean="plane"', 'detector.mean: can\'t be "plane": did you mean plain?'),
        (
            'estimator[0].locals[0].policy={kind="inflate", b=0.98}',
            "estimator[0].locals[0].policy: b is a key of kind 'sage_husa', not of 'inflate': leave it out",
        ),
        (
            'estimator[0].locals[0].policy={kind="sage_husa", reject_above=50.0}',
            "estimator[0].locals[0].policy: reject_above is a key of kind 'inflate', not of 'sage_husa': leave it out",
        ),
        ('estimator[0].locals[0].policy={kind="sage_husa", b=1.0}', "estimator[0].locals[0].policy.b: must be less"),
        ('estimator[0].engine="unscented"', "engine: is a key of kind 'ins', not of 'federated': give it to"),
        ('estimator[0].locals[0].engine="ukf"', 'locals[0].engine: can\'t be "ukf": choose from linear, unscented'),
        ('estimator[0].kind="ins"', "estimator[0].locals: is a key of kind 'federated', not of 'ins': leave it out"),
    ],
)
def test_federated(override: str, said: str) -> None:
    federated = (
        'estimator=[{name="fed", kind="federated", locals=['
        '{name="one", aids=["gnss"]}, {name="air", aids=["barometer", "airspeed"]}]}]'
    )
    extra = ["estimator[0].aids=[]"] if 'kind="ins"' in override else []
    assert said in complaint(U_TURN, federated, "expect={}", override, *extra)


BLOCKED = "fault=[{name='blocked',sensor='airspeed',channel='speed',kind='stuck',window=[60,90],value=5}]"


@pytest.mark.parametrize(
    ("overrides", "key", "said"),
    [
        ([BLOCKED], "ins.detection_delay_s.block", 'there is no fault "block": did you mean blocked?'),
        ([BLOCKED], "ins.detection_delay_s.blocked", ""),
        (["estimator[0].smooth=true"], "ins_smoothed.nis_mean.barometer", "'ins_smoothed' looks back, and has nothing"),
        ([], "ins.nis_mean.sideslip", ""),
        (["sensors.airspeed.slips=true"], "ins.nis_mean.sideslip", 'there is no aid of ins "sideslip"'),
        (["estimator[0].course={}"], "ins.nis_mean.gnss_course", ""),
        ([], "ins.nis_mean.gnss_course", 'there is no aid of ins "gnss_course"'),
        (["estimator[0].zero_velocity_mps=0.1"], "ins.nis_mean.zero_velocity", ""),
        (["estimator[0].kind=ahrs"], "ins.nis_mean.barometer", 'no aid of ins "barometer": choose from level, magn'),
        (["estimator[0].kind=ahrs", "estimator[0].aids=['magnetometer']"], "ins.rejected_fraction.level", ""),
    ],
)
def test_what_is_expected_is_of_an_aid_or_a_fault_that_there_is(overrides: list[str], key: str, said: str) -> None:
    """The whole flight was flown, and then the metric was missing."""
    given = [*overrides, f"expect={{'{key}'=3}}"]
    if said:
        assert f'expect."{key}": ' in complaint(U_TURN, *given)
        assert said in complaint(U_TURN, *given)
    else:
        assert list(Scenario.parse(U_TURN, given).expect) == [key]


def test_aids_are_called_what_filters_call_them() -> None:
    """Of every kind of sensor, with all that its aid may have beside."""
    kinds = set(registry.BUILT_IN) - {"imu"}
    assert set(expected.AIDS) == kinds
    named = ",".join(f"{kind}={{}}" for kind in sorted(kinds - {"position_fix"}))
    fix = "position_fix={transponder={lat_deg=47,lon_deg=8,range_m=1000}}"
    rig = Scenario.parse(U_TURN, [f"sensors={{imu={{}},{named},{fix}}}", "expect={}"]).rig(1)
    for kind, parts in expected.AIDS.items():
        aid = aid_of(kind, rig, rig.imu_errors("imu"), rig.air(None, None), 0.1)
        assert aid is not None
        assert {part for part, _ in aid.parts} >= set(parts) - {"gnss_course", "terrain_fix"}
        assert {part for part, _ in aid.parts} <= set(parts)


def test_federated_without_sharing() -> None:
    override = (
        'estimator=[{name="fed", kind="federated", structure="full_reset", sharing="none",'
        ' locals=[{name="one", aids=["gnss"]}]}]'
    )
    assert "would count the same information again and again" in complaint(U_TURN, override, "expect={}")


def test_federated_recall_needs_filters_of_their_own() -> None:
    override = (
        'estimator=[{name="fed", kind="federated", structure="full_reset", recall_s=20,'
        ' locals=[{name="one", aids=["gnss"]}]}]'
    )
    message = complaint(U_TURN, override, "expect={}")
    assert "recall_s: structure 'full_reset' spreads what it would take back" in message


@pytest.mark.parametrize("kind", ['{"" = 0}', "3", "[1]", '{a = "x:y"}'])
@pytest.mark.parametrize(("part", "key"), [("estimator.ins", "estimator[0]"), ("sensors.gnss", "sensors.gnss")])
def test_a_kind_that_is_no_text(part: str, key: str, kind: str) -> None:
    assert f"{key}.kind: must be text in quotes" in complaint(U_TURN, f"{part}.kind={kind}")


@pytest.mark.parametrize("key", ["title", "truth.aircraft"])
def test_a_text_that_must_not_be_empty(key: str) -> None:
    assert f"{key}: must not be empty" in complaint(U_TURN, f'{key}=""')


def test_two_aids_of_a_kind() -> None:
    message = complaint(U_TURN, 'sensors.second={kind = "gnss"}', 'estimator.ins.aids=["gnss", "second"]')
    assert "estimator[0].aids[1]: 'second' is a second 'gnss': 'ins' takes one of each kind" in message


def test_a_sensor_that_is_no_aid_of_the_estimator() -> None:
    message = complaint(U_TURN, 'estimator.ins.kind="ahrs"', 'estimator.ins.aids=["magnetometer", "gnss"]')
    assert "estimator[0].aids[1]: 'gnss' is of kind 'gnss', which does not aid 'ahrs'" in message


def test_a_plan_belongs_to_a_flight_and_a_flight_to_a_plan() -> None:
    assert "plan: a flight needs a plan" in complaint(U_TURN, "plan=[]")
    static = TEXTS["static_bench"] + '[[plan]]\nleg = "straight"\nlength_m = 100\n'
    assert "plan: a body of source 'kinematic' flies no plan" in complaint(static)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("truth.start.airspeed_mps=12", "truth.start.airspeed_mps: 12 m/s true airspeed "),
        ("plan[1].radius_m=80", "plan[1].radius_m: 80 m "),
        ("plan[2].airspeed_mps=45", "plan[2].airspeed_mps: 45 m/s true airspeed "),
        ("plan[0].alt_m=10", "plan[0].alt_m: "),
    ],
)
def test_a_plan_that_cannot_be_flown(override: str, says: str) -> None:
    assert complaint(U_TURN, override).startswith(f"mine.toml (--set {override}): {says}")


def test_wind_profile_or_wind() -> None:
    both = complaint(U_TURN, "truth.wind.profile=[[0, 250, 3]]")
    assert "truth.wind: a profile replaces from_deg and speed_mps" in both
    falling = complaint(U_TURN, "truth.wind={profile=[[900, 250, 3], [100, 250, 3]]}")
    assert "truth.wind: the rows of profile must climb" in falling
    Scenario.parse(U_TURN, ["truth.wind={profile=[[100, 250, 3], [900, 250, 8]]}"])


# --- files


def load_complaint(path: Path | str) -> str:
    with pytest.raises(UserError) as caught:
        Scenario.load(path)
    return str(caught.value)


def test_files_that_are_no_scenarios(tmp_path: Path) -> None:
    empty, latin, long = tmp_path / "empty.toml", tmp_path / "latin.toml", tmp_path / "long.toml"
    empty.write_text("# nothing yet\n\n")
    latin.write_bytes('seed = 1\ntitle = "Über den Wolken"\n'.encode("latin-1"))
    long.write_text("# " + "x" * 2_000_000)
    assert load_complaint(tmp_path) == f"{tmp_path}: is a folder: give a scenario file in it"
    assert load_complaint(tmp_path / "none.toml") == f"{tmp_path / 'none.toml'}: no such file"
    assert load_complaint(empty).startswith(f"{empty}: is empty: begin with a copy of ")
    assert load_complaint(latin) == f"{latin}:2: is not UTF-8 text: save the file as UTF-8"
    assert load_complaint(long) == f"{long}: is larger than 1000 kB: is this a scenario file?"
    assert "is larger than" in load_complaint("/dev/zero")
    assert "too long" in load_complaint("a" * 5000)


def test_names_that_are_not_shipped() -> None:
    assert load_complaint("uturn").endswith("did you mean u_turn?")
    assert "shipped are closed_loop_ahrs_only, closed_loop_gnss_outage, closed_loop_" in load_complaint("zzz")


# --- whatever comes


JUNK = st.one_of(
    st.none().map(lambda _: "x"),
    st.booleans(),
    st.integers(),
    st.integers(10**18, 10**400),
    st.floats(),
    st.floats(-10, 10).map(lambda x: round(x, 2)),
    st.text(max_size=12),
    st.sampled_from(["imu", "gnss", "ins", "flight", "kinematic", "straight", "loiter", "none", "../..", "a.b", "1"]),
    st.sampled_from([[], {}, [[]], [{}], {"": 0}, [[1, 2]], [[5, 3]], [[1, 2], [1, 2]], {"kind": 3}, {"name": []}]),
    st.recursive(
        st.integers() | st.floats() | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=6,
    ),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


NAMES = st.text(max_size=8) | st.sampled_from([place[-1] for place in places(tomllib.loads(U_TURN + FAULTY))[1:]]).map(
    str
)
ACCIDENTS = ["drop", "double", "rename", "replace", "replace"]


@st.composite
def mutated_documents(draw: st.DrawFn) -> str:
    """A scenario after a few accidents: keys dropped, renamed, added; values replaced, moved, doubled."""
    data: dict[str, Any] = tomllib.loads(draw(st.sampled_from([*TEXTS.values(), U_TURN + FAULTY])))
    for _ in range(draw(st.integers(1, 4))):
        *above, last = draw(st.sampled_from(places(data)[1:] or [("title",)]))
        parent: Any = data
        for step in above:
            parent = parent[step]
        accidents = ["replace"] if isinstance(parent, dict) and last not in parent else ACCIDENTS
        match draw(st.sampled_from(accidents)), parent:
            case "drop", _:
                del parent[last]
            case "double", list():
                parent.append(copy.deepcopy(parent[last]))
            case "double", dict():
                parent[draw(NAMES)] = copy.deepcopy(parent[last])
            case "rename", dict():
                parent[draw(NAMES | st.just(f"{last}s"))] = parent.pop(last)
            case _:
                parent[last] = copy.deepcopy(draw(JUNK))
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in data.items())


@st.composite
def mutated_texts(draw: st.DrawFn) -> str:
    """A shipped scenario with bits of its text deleted, doubled, swapped or overwritten."""
    text = TEXTS[draw(st.sampled_from(sorted(TEXTS)))]
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(text)))
        stop = min(len(text), start + draw(st.integers(0, 30)))
        fill = draw(
            st.text(max_size=5) | st.sampled_from(["[", "]]", "{", '"""', "'''", "=", "\n", ".", "#", "e", "-"])
        )
        text = text[:start] + draw(st.sampled_from([fill, "", text[start:stop] * 2])) + text[stop:]
    return text


def toml(value: Any) -> str:
    """TOML for what `tomllib` gives or `JUNK` has."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{basic(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return basic(value) if isinstance(value, str) else str(value)


def basic(text: str) -> str:
    return json.dumps(text).replace("\x7f", "\\u007f")


def loads_or_complains(text: str, overrides: list[str]) -> Scenario | None:
    try:
        scenario = Scenario.parse(text, overrides, Path("mine.toml"))
    except UserError as error:
        for line in str(error).splitlines():
            assert re.match(r"mine\.toml(:\d+| \(--set .*\))?: .|--set .", line, re.DOTALL), line
            assert "pydantic" not in line
        return None
    assert scenario.title
    Faults(scenario.fault, scenario.sensors, scenario.seed)
    if scenario.truth.source != "log":  # whose sensors are not simulated, and which says itself where it begins
        for name, config in scenario.sensors.items():
            sensors.build(name, config, scenario.truth.rate_hz, scenario.seed, scenario.site())
    assert dict(Scenario.parse(scenario.text, scenario.overrides)) == dict(scenario)
    return scenario


DOCUMENTS = mutated_documents() | mutated_texts()
KEYS = st.sampled_from(
    ["seed", "plan[0].leg", "sensors.gnss.denied", "estimator.ins.aids", "truth.wind", "truth.start.lat"]
)
OVERRIDES = st.lists(
    st.text(max_size=15) | st.builds("{}={}".format, KEYS | st.text(max_size=6), JUNK.map(toml) | st.text(max_size=9)),
    max_size=2,
)
PATIENT = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


@settings(PATIENT)
@given(DOCUMENTS, OVERRIDES)
def test_only_clean_loads_or_clean_errors(text: str, overrides: list[str]) -> None:
    loads_or_complains(text, overrides)


@pytest.mark.slow
@settings(PATIENT, max_examples=5_000)
@given(DOCUMENTS, OVERRIDES)
def test_only_clean_loads_or_clean_errors_at_length(text: str, overrides: list[str]) -> None:
    scenario = loads_or_complains(text, overrides)
    if scenario is not None and scenario.truth.source == "kinematic":
        run(scenario.model_copy(update={"duration_s": 3.0}))


def test_keys_of_an_ins() -> None:
    blind = complaint(U_TURN, 'estimator.ins.aids=["barometer"]', "estimator.ins.course={}")
    assert "estimator[0].course: needs a GNSS receiver among the aids" in blind
    wheels = complaint(U_TURN, "estimator.ins.nonholonomic_mps=0.1")
    assert "estimator[0].nonholonomic_mps: is used with a body velocity: add such an aid, or leave it out" in wheels
    standing = [f"estimator=[{{name='ins', aids=['barometer'], zero_velocity_mps={sigma}}}]" for sigma in (0.1, 0)]
    only = "sensors={imu={}, barometer={}, magnetometer={}}", "expect={}"
    assert "estimator[0].zero_velocity_mps: needs a GNSS receiver" in complaint(U_TURN, *only, standing[0])
    assert "estimator[0].zero_velocity_mps" in complaint(U_TURN, *only, standing[1])
    named = "sensors={imu={}, gnss={}, zero_velocity={kind='barometer'}, magnetometer={}}", "expect={}"
    assert "zero_velocity_mps: takes the name 'zero_velocity'" in complaint(
        U_TURN, *named, "estimator=[{name='ins', aids=['gnss'], zero_velocity_mps=0.1}]"
    )
    ahrs = complaint(TEXTS["loiter_ahrs_continuous"], 'estimator.gyros.engine="unscented"')
    assert "estimator[2].engine: is a key of kind 'ins', not of 'ahrs'" in ahrs
    ahrs = complaint(TEXTS["loiter_ahrs_continuous"], 'estimator.gyros.states="full"')
    assert "estimator[2].states: is a key of kind 'ins' or 'federated', not of 'ahrs'" in ahrs
    assert 'estimator[0].states: can\'t be "scale": choose from biases, full' in complaint(
        U_TURN, 'estimator.ins.states="scale"'
    )
    assert "fading.looks" in complaint(U_TURN, 'estimator.ins.fading={ looks = ["gnss_heading"] }')
    assert "sage_husa.b" in complaint(U_TURN, "estimator.ins.sage_husa={ b = 1.0 }")
