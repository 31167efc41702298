"""The scenario format: what loads, what overrides do, and that errors name the line and the key."""

from __future__ import annotations

import datetime as dt
import pickle
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.scenario import Bounds, Scenario, keypath

U_TURN = (data_dir("scenarios") / "u_turn.toml").read_text("utf-8")


def test_values_arrive_where_they_belong() -> None:
    scenario = Scenario.load("u_turn")
    assert isinstance(scenario.truth, FlightTruth)
    assert scenario.truth.start.airspeed_mps == 25.0
    assert scenario.truth.wind.turbulence == "light"
    assert [leg.leg for leg in scenario.plan] == ["straight", "u_turn", "straight"]
    assert scenario.estimator[0].aids == ("gnss", "barometer", "magnetometer", "airspeed")
    assert scenario.date == dt.date(2026, 6, 1)
    assert isinstance(Scenario.load("static_bench").truth, KinematicTruth)


def test_overrides_may_be_values_of_python() -> None:
    given = {
        "duration_s": 60,
        "expect": {},
        "sensors.gnss.denied": np.array([[10.0, 20.0]]),
        "sensors.gnss.rate_hz": np.float64(2.0),
        "record.imu": True,
        "date": dt.date(2027, 1, 2),
        "title": 'of "π" \\ \t\x7f 😀',
        "fault": [{"kind": "step", "sensor": "barometer", "channel": "pressure", "window": (5, 15), "size": 30}],
    }
    scenario = Scenario.load("u_turn", given)
    assert scenario.duration_s == 60
    assert not scenario.expect
    assert scenario.sensors["gnss"].denied == ((10.0, 20.0),)
    assert scenario.sensors["gnss"].rate_hz == 2.0
    assert scenario.record.imu
    assert scenario.date == given["date"]
    assert scenario.title == given["title"]
    assert scenario.fault[0].window == (5.0, 15.0)
    assert dict(Scenario.parse(scenario.text, scenario.overrides)) == dict(scenario)  # a record says them as texts


def test_an_override_of_no_kind_that_a_scenario_has() -> None:
    with pytest.raises(UserError, match=r"duration_s = None: .* and no NoneType"):
        Scenario.load("u_turn", {"duration_s": None})


def test_a_path_loads_like_a_name(tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    copy.write_bytes(b"\xef\xbb\xbf" + U_TURN.replace("\n", "\r\n").encode())  # as some editors save it
    assert dict(Scenario.load(copy)) == dict(Scenario.load("u_turn"))
    assert Scenario.load(str(copy)).path == copy


def test_it_survives_pickling_with_its_text() -> None:
    scenario = Scenario.load("u_turn", ["seed=5"])
    again = pickle.loads(pickle.dumps(scenario))
    assert again == scenario
    assert (again.text, again.overrides, again.path) == (scenario.text, ("seed=5",), scenario.path)


def test_text_and_overrides_make_the_scenario_again() -> None:
    scenario = Scenario.load("u_turn", ["seed=5", "sensors.gnss.denied=[[50, 80]]"])
    assert dict(Scenario.parse(scenario.text, scenario.overrides)) == dict(scenario)
    assert dict(Scenario.parse(scenario.text)) != dict(scenario)


def test_a_sensor_may_have_any_name_when_it_says_its_kind() -> None:
    overrides = ['sensors.second={kind = "gnss", rate_hz = 1}', 'estimator.ins.aids=["second"]']
    assert type(Scenario.load("u_turn", overrides).sensors["second"]) is type(Scenario.load("u_turn").sensors["gnss"])


@pytest.mark.parametrize(
    ("override", "read"),
    [
        ("seed=11", lambda s: s.seed == 11),
        (
            "sensors.gnss.denied=[[30, 50], [90, 120]]",
            lambda s: list(s.sensors["gnss"].denied) == [(30, 50), (90, 120)],
        ),
        ("sensors.gnss.rate_hz = 10", lambda s: s.sensors["gnss"].rate_hz == 10.0),
        ("plan[0].length_m=900", lambda s: s.plan[0].length_m == 900.0),
        ("plan.2.length_m=900", lambda s: s.plan[2].length_m == 900.0),
        ("plan[1].direction=right", lambda s: s.plan[1].direction == "right"),
        ('plan[1].direction="right"', lambda s: s.plan[1].direction == "right"),
        ("estimator.ins.aids=[]", lambda s: s.estimator[0].aids == ()),
        ("truth.wind.turbulence=none", lambda s: s.truth.wind.turbulence == "none"),
        ("record.imu=false", lambda s: s.record.imu is False),  # the file has no [record]: the table is made
        (
            'expect."ins.recovery_s"={min=0.1, max=3}',
            lambda s: "ins.recovery_s" in s.expect and s.expect["ins.recovery_s"].min == 0.1,
        ),
    ],
)
def test_override(override: str, read: Callable[[Any], bool]) -> None:
    assert not read(Scenario.load("u_turn"))
    assert read(Scenario.load("u_turn", [override]))


def test_the_last_override_of_a_key_wins() -> None:
    assert Scenario.load("u_turn", ["seed=3", "seed=4"]).seed == 4


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("seed", "key=value"),
        ("=3", "can't read the key"),
        ("plan..leg=3", "can't read the key"),
        ("plan[7].leg=3", "plan has 3 items"),
        ("plan.climb.leg=3", "plan is a list: select a number"),
        ("estimator.inz.aids=[]", "select a number or one of ins"),
        ("title.x=3", "title is a single value"),
        ("sensors.gnss.rat_hz=3", "sensors.gnss.rat_hz: unknown key: did you mean rate_hz"),
        ("sensors.gnss.denied=[[300, 500]", 'sensors.gnss.denied: must be a list, not "\\[\\[300, 500\\]"'),
        ("seed=1 2", "seed: must be a whole number"),
    ],
)
def test_a_wrong_override_is_named(override: str, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        Scenario.load("u_turn", [override])
    assert f"--set {override}" in str(caught.value)


def test_bounds() -> None:
    assert Bounds.model_validate(3.0).hold(3.0)
    assert not Bounds.model_validate(3.0).hold(3.1)
    assert not Bounds.model_validate({"min": 1.0}).hold(0.9)
    assert not Bounds.model_validate({"min": 1.0}).hold(float("nan"))
    assert not Bounds.model_validate(1.0).hold(float("nan"))
    assert str(Bounds.model_validate({"min": 0.5, "max": 2})) == "0.5 … 2"


# --- lines


DOCUMENT = '''\
title = "a # [x] = 1"   # comment [y]
grid = [[1.5, 2],
  [3,   # inside
   4]]
day = 1979-05-27 07:32:00
text = """
[not.a.table]
"quoted" = 1
"""
raw = \'\'\'
[nor] this\'\'\'

[a."b.c"]
k.l = {p = 1, q = [1,
  {z = 2}]}
[[plan]]
leg = 's'

[[plan]]
leg = 't'
[plan.sub]
u = 1
[[plan.items]]
r = 1
[[plan.items]]
r = 2
'''


def test_line_numbers() -> None:
    tomllib.loads(DOCUMENT)
    lines = keypath.line_numbers(DOCUMENT)
    assert {keypath.written(path): line for path, line in lines.items() if line > 4} == {
        "day": 5,
        "text": 6,
        "raw": 10,
        "a": 13,
        'a."b.c"': 13,
        'a."b.c".k': 14,
        'a."b.c".k.l': 14,
        'a."b.c".k.l.p': 14,
        'a."b.c".k.l.q': 14,
        'a."b.c".k.l.q[0]': 14,
        'a."b.c".k.l.q[1]': 15,
        'a."b.c".k.l.q[1].z': 15,
        "plan": 16,
        "plan[0]": 16,
        "plan[0].leg": 17,
        "plan[1]": 19,
        "plan[1].leg": 20,
        "plan[1].sub": 21,
        "plan[1].sub.u": 22,
        "plan[1].items": 23,
        "plan[1].items[0]": 23,
        "plan[1].items[0].r": 24,
        "plan[1].items[1]": 25,
        "plan[1].items[1].r": 26,
    }
    assert lines["title",] == 1
    assert lines["grid",] == 2
    assert lines["grid", 0, 1] == 2
    assert lines["grid", 1] == 3
    assert lines["grid", 1, 1] == 4


values = st.recursive(
    st.integers()
    | st.booleans()
    | st.sampled_from(['"a [b] # c"', "'x = {'", '"""\n[t]\nk = 1\n"""', "1979-05-27", "-1.5e3", "inf", '"\\"]"'])
    | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abcd"), inner, max_size=3),
    max_leaves=8,
)


def toml(value: Any) -> str:
    """TOML for one value; a string is taken as TOML already. Lists go over several lines."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[\n" + ",  # and\n".join(map(toml, value)) + "\n]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    return str(value)


@pytest.mark.ci
@given(st.lists(st.dictionaries(st.sampled_from(["a", "b.c", '"d e"', "f"]), values, max_size=4), max_size=4))
def test_line_numbers_cover_exactly_what_the_parser_finds(tables: list[dict[str, Any]]) -> None:
    text = "".join("[[t]]\n" + "".join(f"{k} = {toml(v)}\n" for k, v in table.items()) for table in tables)

    def paths(value: Any, path: keypath.KeyPath) -> set[keypath.KeyPath]:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        return {path}.union(*(paths(item, (*path, key)) for key, item in items))

    lines = keypath.line_numbers(text)
    assert set(lines) | {()} == paths(tomllib.loads(text), ())
    for number, line in enumerate(text.splitlines(), start=1):
        if line == "[[t]]":
            assert number in lines.values()


@pytest.mark.parametrize("name", [None, 3])
def test_what_is_no_file_is_told(name: Any) -> None:
    with pytest.raises(UserError, match=r"Scenario\.load: .* is neither a file nor a shipped name"):
        Scenario.load(name)
    with pytest.raises(UserError, match=r"Scenario\.parse: .* is no text: Scenario\.load reads a file"):
        Scenario.parse(b"seed = 1")  # type: ignore[arg-type]


def test_one_override_may_be_a_text() -> None:
    assert Scenario.load("static_bench", "duration_s=61").duration_s == 61.0
    with pytest.raises(UserError, match="unknown key"):
        Scenario.load("static_bench", {3: True})  # type: ignore[dict-item]
