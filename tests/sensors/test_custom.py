"""Anybody's sensor: found, sensed, recorded, and aiding the filters."""

import dataclasses
import pickle
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from nav.aids import GnssAid
from nav.aids.base import Aid
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.record.reader import load
from testbed.report import page as report
from testbed.sensors import custom, registry
from testbed.sensors.magnetometer import MagnetometerConfig

RADAR = """
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from nav.earth import isa_pressure
from nav.samples import BarometerSample, MagnetometerSample
from nav.aids import BarometerAid
from nav.aids.base import Measurement
from testbed.noise import Process, stream
from testbed.sensors.magnetometer import Magnetometer, MagnetometerConfig
from testbed.sensors.timing import AidingTiming, Schedule


@dataclass(frozen=True, slots=True)
class HeightSample:
    t: float
    t_arrival: float
    height: float = field(metadata={"unit": "m", "meaning": "height above the ellipsoid"})
    sensor: str = "radar"


@dataclass(frozen=True)
class Timeless:
    height: float


class Radar:
    class Section(AidingTiming):
        noise_m: float = Field(0.5, ge=0, description="1 sigma")
        beams: list[list[float]] = []
        arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
        how: str = ""

    def __init__(self, name, section, tick_rate_hz, seed):
        self.how = section.how
        if self.how == "init":
            raise ValueError("no antenna")
        if self.how == "init exit":
            raise SystemExit(4)
        self.name, self.schedule = name, Schedule.of(name, section, tick_rate_hz)
        self.white = Process.white(stream(seed, name, "white"), [section.noise_m])

    def sense(self, truth):
        rows = self.schedule.rows(truth)
        noise = self.white.take(len(rows))[:, 0] if len(rows) else ()
        if self.how == "write":
            truth.h[:] = 0.0
        if self.how == "exit":
            raise SystemExit(3)
        as_given = np.asarray if self.how == "array" else float
        if self.how in WRONG:
            return WRONG[self.how]()
        return [
            HeightSample(as_given(truth.t[k]), as_given(truth.t[k] + self.schedule.latency), truth.h[k] + e, self.name)
            for k, e in zip(rows, noise)
        ]


def generated():
    yield HeightSample(0.0, 0.0, 1.0)
    raise ValueError("no echo")


WRONG = {
    "gone": lambda: (_ for _ in ()).throw(GeneratorExit),
    "two axes": lambda: [MagnetometerSample(0.0, 0.0, np.zeros(2), "radar")],
    "one": lambda: [BarometerSample(0.0, 0.0, np.zeros(1), "radar")],
    "nothing": lambda: [BarometerSample(0.0, 0.0, None, "radar")],
    "none": lambda: None,
    "dict": lambda: [{"t": 0.0}],
    "timeless": lambda: [Timeless(1.0)],
    "nan": lambda: [HeightSample(float("nan"), 0.0, 1.0)],
    "text": lambda: [HeightSample("now", 0.0, 1.0)],
    "before": lambda: [HeightSample(-1.0, 0.0, 1.0)],
    "early": lambda: [HeightSample(2.0, 1.0, 1.0)],
    "other": lambda: [HeightSample(0.0, 0.0, 1.0, "lidar")],
    "words": lambda: [HeightSample(0.0, 0.0, "high")],
    "matrix": lambda: [HeightSample(0.0, 0.0, np.eye(2))],
    "mixed": lambda: [HeightSample(0.0, 0.0, 1.0), HeightSample(0.0, 0.0, np.zeros(2))],
    "raise": lambda: np.linalg.inv(np.zeros((2, 2))),
    "late": generated,
}


class HeightAid:
    sensor, parts, states = "radar", (("radar", 1),), ()

    def __init__(self, how):
        self.how = how
        named = {"parts": 3, "aid slash": (("a/b", 1),), "aid twice": (("radar", 1), ("radar", 1))}
        named["aid ours"] = (("gnss_position", 1),)
        named["aid dimension"] = (("time", 1),)
        self.parts = named.get(how, self.parts)

    def blocks(self):
        return ["bias"] if self.how == "blocks" else []

    def measure(self, part, sample, at):
        nu, H, R = np.zeros(1), np.zeros((1, len(at.x))), np.ones(1)
        match self.how:
            case "aid raise":
                return at.no_such_thing
            case "aid dict":
                return {"nu": nu}
            case "aid nan":
                nu[0] = np.nan
            case "aid H":
                H = np.zeros((1, 3))
            case "aid R":
                R[0] = -1.0
            case "aid R0":
                R[0] = 0.0
            case "aid text":
                R = ["1.0"]
            case "aid lists":
                nu, H, R = [0], H.tolist(), [1]
            case "aid write":
                at.x[:], at.P[:], at.state.v_n[:], at.state.P[:] = 1.0, 0.0, 50.0, 0.0
        return None if self.how == "aid none" else Measurement(nu, H, R)


# made of one of ours: what it measures is wrong by 20, unless it is told otherwise
class HalfAid(BarometerAid):
    how = ""

    @property
    def parts(self):
        return (("a/b", 1),) if type(self).how == "made slash" else super().parts

    def measure(self, part, sample, at):
        found = super().measure(part, sample, at)
        match type(self).how:
            case "made raise":
                return at.no_such_thing
            case "made nan":
                return found._replace(nu=np.array([np.nan]))
        return found._replace(nu=found.nu - 20.0)


class Halved(Radar):
    def sense(self, truth):
        return [
            BarometerSample(one.t, one.t_arrival, float(isa_pressure(one.height)), self.name)
            for one in super().sense(truth)
        ]

    @staticmethod
    def aid(name, section, imu):
        return type("HalfAid", (HalfAid,), {"how": section.how})(name)


class Aided(Radar):
    @staticmethod
    def aid(name, section, imu):
        return HeightAid(section.how)


class Aiding(Radar):
    @staticmethod
    def aid(name, section, imu):
        if section.how == "typo":
            raise ValueError("no such aid")
        if section.how == "aid exit":
            raise SystemExit(5)
        return None if section.how == "none aided" else section


class Compass(Magnetometer):
    Section = MagnetometerConfig
"""
AT_REST = """
title = "At rest, with a sensor of the user's"
seed = 11
duration_s = 2
truth = { source = "kinematic", rate_hz = 50, start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 500 } }
sensors.imu = { rate_hz = 50 }
sensors.gnss = { rate_hz = 5 }
sensors.magnetometer = { rate_hz = 5 }
sensors.radar = { kind = "./radar.py:Radar", rate_hz = 5 }

[[estimator]]
name = "ins"
aids = ["gnss", "magnetometer"]
"""


def at(text: str) -> str:
    """Where a text stands in the file."""
    return f"radar.py, line {RADAR[: RADAR.index(text)].count(chr(10)) + 1}"


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("radar")
    (folder / "radar.py").write_text(RADAR)
    text = (Path(__file__).parents[2] / "scenarios/u_turn.toml").read_text("utf-8").partition("[expect]")[0]
    (folder / "own.toml").write_text(f'{text}\n[sensors.radar]\nkind = "./radar.py:Radar"\nrate_hz = 5\n', "utf-8")
    (folder / "rest.toml").write_text(AT_REST, "utf-8")
    return folder / "own.toml"


@pytest.mark.ci
def test_it_is_recorded_with_unit_and_noise(scenario: Path) -> None:
    dropout = {"sensor": "radar", "kind": "dropout", "window": [10.0, 15.0]}
    result = run(Scenario.load(scenario, {"duration_s": 20, "fault": [dropout], "sensors.radar.noise_m": 2.0}))
    own, truth = result.dataset["sensors/radar"], result.dataset["truth"]
    assert own["height"].attrs["units"] == "m"
    t = own["time"].values
    assert not ((t >= 10.0) & (t < 15.0)).any()
    error = own["height"].values - np.interp(t, truth["time"].values, truth["h"].values)
    assert 1.5 < error.std() < 2.6


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"sensors.radar.noise": 1.0}, "sensors.radar.noise: unknown key: did you mean noise_m?"),
        ({"sensors.radar.arm_m": [0.0, 1.0]}, "sensors.radar.arm_m[2]: is missing: this item needs one more value"),
        ({"sensors.radar.beams": [1]}, "sensors.radar.beams[0]: must be a list, not 1"),
        ({"sensors.radar.beams": [[1.0, "a"]]}, 'sensors.radar.beams[0][1]: must be a number, not "a"'),
        ({"sensors.radar.beams": [[1.0, float("inf")]]}, "sensors.radar.beams[0][1]: must be a finite number, not inf"),
        ({"sensors.radar.noise_m": "1"}, 'sensors.radar.noise_m: must be a number, not "1"'),
        ({"sensors.radar.noise_m": -1.0}, "sensors.radar.noise_m: must be greater than or equal to 0"),
        ({"sensors.radar.kind": "./radar.py:Rader"}, 'there is no class in ./radar.py "Rader": did you mean Radar?'),
        ({"sensors.radar.kind": "./radar.py:HeightSample"}, "lacks a Section"),
        ({"estimator[0].aids": ["gnss", "radar"]}, "'radar' is of kind './radar.py:Radar', which does not aid 'ins'"),
    ],
)
def test_what_is_wrong_is_said(scenario: Path, overrides: dict[str, object], says: str) -> None:
    with pytest.raises(UserError) as told:
        Scenario.load(scenario, overrides)
    assert says in str(told.value)


def test_one_that_aids_filters_does_not_aid_an_ahrs(scenario: Path) -> None:
    """Which ended in a traceback: its aids are three kinds of ours. Those of the user's are handed any sample."""
    rest, keys = (
        scenario.with_name("rest.toml"),
        {"sensors.radar.kind": "./radar.py:Aided", "estimator[0].kind": "ahrs"},
    )
    with pytest.raises(UserError) as told:
        Scenario.load(rest, {**keys, "estimator[0].aids": ["magnetometer", "radar"]})
    assert "estimator[0].aids[1]: 'radar' is of kind './radar.py:Aided', which does not aid 'ahrs'" in str(told.value)
    with pytest.raises(UserError) as told:
        Scenario.load(rest, {**keys, "estimator[0].aids": ["magnetometer", "rada"]})
    assert str(told.value).endswith('there is no sensor "rada": choose from magnetometer')
    (scenario.parent / "filters.py").write_text("class Mine: ...")
    mine = {"name": "mine", "kind": "./filters.py:Mine", "aids": ["magnetometer", "radar"]}
    assert Scenario.load(rest, {"estimator": [mine]}).estimator[0].aids == ("magnetometer", "radar")


def test_its_lists_may_be_lists_or_tuples(scenario: Path) -> None:
    keys = {"sensors.radar.beams": [[1, 0.1], [2.5]], "sensors.radar.arm_m": [0.1, 0.1, 0.2]}
    own = Scenario.load(scenario, keys).sensors["radar"]
    assert own.beams == [[1.0, 0.1], [2.5]]
    assert own.arm_m == (0.1, 0.1, 0.2)


def test_a_scenario_with_it_can_be_sent(scenario: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To another process too, which has not seen its class, and with what was changed since it was loaded."""
    loaded = Scenario.load(scenario, {"sensors.radar.noise_m": 2.0}).model_copy(update={"duration_s": 7.0})
    sent = pickle.dumps(loaded)
    for name in [name for name in sys.modules if name.startswith("radar_")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(registry, "_CUSTOM", {})
    monkeypatch.setattr(registry, "_BY_SECTION", {kind.section: kind for kind in registry.BUILT_IN.values()})
    monkeypatch.chdir("/")
    found = pickle.loads(sent)
    own = found.sensors["radar"]
    assert registry.of(own).sensor.__name__ == "Radar"
    assert (own.noise_m, own.kind, found.duration_s) == (2.0, "./radar.py:Radar", 7.0)
    assert (found.text, found.path, found.overrides) == (loaded.text, loaded.path, loaded.overrides)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("init", f"can't be made: ValueError: no antenna ({at('no antenna')})"),
        ("exit", f"SystemExit: 3 ({at('SystemExit(3)')})"),
        ("init exit", f"can't be made: SystemExit: 4 ({at('SystemExit(4)')})"),
        ("raise", f"LinAlgError: Singular matrix ({at('linalg')})"),
        ("late", f"ValueError: no echo ({at('no echo')})"),
        ("gone", "GeneratorExit"),
        ("two axes", "sense gave a MagnetometerSample whose field_b has shape (2,)"),
        ("one", "sense gave a BarometerSample whose pressure has shape (1,)"),
        ("nothing", "sense gave a sample whose pressure is null: it must be a number"),
        ("none", "sense gave NoneType: give a list of samples"),
        ("dict", "sense gave dict where a sample was expected"),
        ("timeless", "sense gave Timeless, which lacks t, t_arrival, sensor"),
        ("nan", "sense gave a sample whose t is nan"),
        ("text", 'sense gave a sample whose t is "now"'),
        ("before", "sense gave a sample of -1 s, before the run begins: leave it out"),
        ("early", "sense gave a sample that arrives at 1 s, before it is true at 2 s"),
        ("other", 'sense gave a sample of sensor "lidar", not "radar"'),
        ("words", 'sense gave a sample whose height is "high": it must be a number'),
        ("matrix", "sense gave a sample whose height has shape (2, 2)"),
        ("mixed", "sense gave a sample whose height has shape (2,)"),
    ],
)
def test_what_is_no_sample_ends_the_run_with_a_line(scenario: Path, how: str, says: str) -> None:
    with pytest.raises(UserError) as told:
        run(Scenario.load(scenario.with_name("rest.toml"), {"sensors.radar.how": how}))
    assert re.match(rf"sensor radar: \./radar\.py:Radar:? {re.escape(says)}", str(told.value)), told.value


def test_lists_of_any_lengths_are_recorded(tmp_path: Path) -> None:
    """Two lengths in one sample, or a list that is called as a number of ours is, ended in a ValueError."""
    (tmp_path / "radar.py").write_text(
        RADAR + "\n\n@dataclass(frozen=True)\nclass Beams:\n    t: float\n    t_arrival: float\n    range: list\n"
        "    width: tuple\n    v_n: list\n    wind_n: list\n    sensor: str = 'radar'\n\n\nclass Many(Radar):\n"
        "    def sense(self, truth):\n        return [\n            Beams(one.t, one.t_arrival, [1.0, one.t],"
        " (1.0, 2.0, 3.0), [4.0, 5.0, 6.0], [one.t])\n            for one in super().sense(truth)\n        ]\n"
    )
    (tmp_path / "rest.toml").write_text(AT_REST, "utf-8")
    run(Scenario.load(tmp_path / "rest.toml", {"sensors.radar.kind": "./radar.py:Many"}), out=tmp_path / "out")
    own = load(tmp_path / "out/run.nc")["sensors/radar"]
    t = own["time"].values
    assert np.array_equal(own["range"].values, np.column_stack([np.ones(len(t)), t]))
    assert np.array_equal(own["width"].values, np.tile([1.0, 2.0, 3.0], (len(t), 1)))
    assert np.array_equal(own["wind_n"].values, t[:, None])
    assert own["v_n"].attrs["units"] == "m/s"
    assert own["v_n"].dims == ("time", "ned")


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("typo", f"ValueError: no such aid ({at('no such aid')})"),
        ("aid exit", f"SystemExit: 5 ({at('SystemExit(5)')})"),
        ("", "aid gave Section, which lacks sensor, parts, states, blocks, measure"),
    ],
)
def test_what_is_no_aid_ends_the_run_with_a_line(scenario: Path, how: str, says: str) -> None:
    keys = {"sensors.radar.kind": "./radar.py:Aiding", "estimator[0].aids": ["gnss", "magnetometer", "radar"]}
    with pytest.raises(UserError) as told:
        run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "sensors.radar.how": how}))
    assert f"sensor radar: ./radar.py:Aiding: {'aid: ' if how else ''}{says}" in str(told.value)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("parts", 'parts = "3" and states = "()": give pairs of a name and its axes, and names'),
        ("aid slash", 'parts has "a/b": give a name without a slash or control characters, no dimension'),
        ("aid twice", 'parts has "radar": give a name without a slash'),
        ("aid dimension", 'parts has "time": give a name without a slash'),
        ("blocks", """blocks gave "['bias']": give a list of nav.error_model.Block"""),
        ("aid raise", f"AttributeError: 'OperatingPoint' object has no attribute 'no_such_thing' ({at('no_such')})"),
        ("aid dict", 'measure gave dict where a Measurement or None was expected of "radar" at '),
        ("aid nan", 'measure gave nu = [nan] of "radar" at '),
        ("aid H", "measure gave H of shape (1, 3), not (1, "),
        ("aid R", 'measure gave variances R = [-1.0], not above 0, of "radar" at '),
        ("aid R0", 'measure gave variances R = [0.0], not above 0, of "radar" at '),
        ("aid text", 'measure gave R = ["1.0"], which are no numbers, of "radar" at '),
    ],
)
def test_what_is_no_measurement_ends_the_run_with_a_line(scenario: Path, how: str, says: str) -> None:
    """An exception of an aid ended in a traceback, and what is not a number was fused."""
    keys = {"sensors.radar.kind": "./radar.py:Aided", "estimator[0].aids": ["gnss", "magnetometer", "radar"]}
    with pytest.raises(UserError) as told:
        run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "duration_s": 4, "sensors.radar.how": how}))
    assert f"sensor radar: ./radar.py:Aided: aid: {says}" in str(told.value)


def test_an_aid_with_a_part_of_ours_has_as_many_axes(scenario: Path) -> None:
    keys = {"sensors.radar.kind": "./radar.py:Aided", "estimator[0].aids": ["gnss", "magnetometer", "radar"]}
    with pytest.raises(UserError, match='sensor radar: aid: part "gnss_position" has 1 axes, and that of another 3'):
        run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "sensors.radar.how": "aid ours"}))


@pytest.mark.parametrize(("how", "looks"), [("", 1), ("aid lists", 1), ("aid none", 0)])
def test_what_is_a_measurement_is_used(scenario: Path, how: str, looks: int) -> None:
    keys = {"sensors.radar.kind": "./radar.py:Aided", "estimator[0].aids": ["gnss", "magnetometer", "radar"]}
    result = run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "duration_s": 4, "sensors.radar.how": how}))
    assert len([one for one in result.dataset.groups if one.endswith("innovations/radar")]) == looks


def test_what_an_aid_writes_into_where_a_filter_is_stays_its_own(scenario: Path) -> None:
    keys = {"sensors.radar.kind": "./radar.py:Aided", "estimator[0].aids": ["gnss", "magnetometer", "radar"]}
    plain, written = (
        run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "duration_s": 4, "sensors.radar.how": how})).dataset
        for how in ("", "aid write")
    )
    for name in ("v_n", "q_nb", "covariance"):
        (path,) = (one for one in plain.groups if one.startswith("/estimators/") and one.count("/") == 2)
        assert np.array_equal(plain[f"{path}/{name}"], written[f"{path}/{name}"], equal_nan=True)


def test_an_aid_made_of_one_of_ours_is_known_as_that() -> None:
    class Mine(GnssAid):
        pass

    made = custom.aid(lambda *_: Mine("mine"), "mine", MagnetometerConfig(), None)
    assert isinstance(made, Mine)
    assert type(made) is type(custom.aid(lambda *_: Mine("other"), "other", MagnetometerConfig(), None))
    assert made == made
    assert dataclasses.replace(made, course=None).sensor == "mine"
    assert made.plain is None  # no kernel knows what it measures
    ours = GnssAid("mine")
    assert custom.aid(lambda *_: ours, "mine", MagnetometerConfig(), None) is ours
    assert isinstance(custom.aid(lambda *_: Own(), "mine", MagnetometerConfig(), None), custom.AidGuard)


MADE = {
    "sensors.radar.kind": "./radar.py:Halved",
    "estimator[0].aids": ["gnss", "magnetometer", "radar"],
    "duration_s": 20,
}


@pytest.mark.ci
@pytest.mark.parametrize("unscented", [False, True])
def test_what_an_aid_made_of_one_of_ours_measures_is_asked_however_the_run_is_cut(
    scenario: Path, unscented: bool
) -> None:
    """Kernels of ours took its place in a batch, so that what it gave depended on the blocks."""
    keys = {**MADE, **({"estimator[0].engine": "unscented"} if unscented else {})}
    loaded = Scenario.load(scenario.with_name("rest.toml"), keys)
    batch, live = run(loaded), run(loaded, realtime=100.0)
    own = [one.dataset["estimators/ins"] for one in (batch, live)]
    nu = own[0]["innovations/barometer"]["innovation"].values[:, 0]
    assert nu[0] < -15.0
    for name in ("lat", "h", "covariance"):
        np.testing.assert_array_equal(own[0][name].values, own[1][name].values)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("made raise", "AttributeError: 'OperatingPoint' object has no attribute 'no_such_thing' (radar.py, line "),
        ("made nan", 'measure gave nu = [nan] of "barometer" at '),
        ("made slash", 'parts has "a/b": give a name without a slash or control characters, no dimension'),
    ],
)
def test_an_aid_made_of_one_of_ours_is_guarded(scenario: Path, how: str, says: str) -> None:
    with pytest.raises(UserError) as told:
        run(Scenario.load(scenario.with_name("rest.toml"), {**MADE, "sensors.radar.how": how}))
    assert f"sensor radar: ./radar.py:Halved: aid: {says}" in str(told.value)


class Own(Aid):
    """Written after the protocol, which makes it none of ours."""

    sensor, parts, states = "mine", (("mine", 1),), ()  # type: ignore[assignment]

    def blocks(self):  # type: ignore[no-untyped-def]
        return []

    def measure(self, part, sample, at):  # type: ignore[no-untyped-def]
        return None


def test_what_it_writes_into_truth_nobody_else_sees(scenario: Path) -> None:
    own = run(Scenario.load(scenario.with_name("rest.toml"), {"sensors.radar.how": "write"})).dataset
    assert abs(own["sensors/radar/height"].values).max() < 10.0
    assert (own["truth/h"].values > 490.0).all()


def test_times_may_be_arrays_without_dimensions(scenario: Path) -> None:
    own, plain = (
        run(Scenario.load(scenario.with_name("rest.toml"), {"sensors.radar.how": how})) for how in ("array", "")
    )
    assert own.dataset["sensors/radar"].identical(plain.dataset["sensors/radar"])


@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_one_that_says_it_aids_nothing_aids_nothing(scenario: Path, kind: str) -> None:
    """In a federated filter it ended in a traceback."""
    aids = ["gnss", "magnetometer", "radar"]
    taken = {"aids": aids} if kind == "ins" else {"locals": [{"name": "one", "aids": aids}]}
    keys = {"sensors.radar.kind": "./radar.py:Aiding", "sensors.radar.how": "none aided", "duration_s": 4}
    estimator = {"name": "mine", "kind": kind, **taken}
    result = run(Scenario.load(scenario.with_name("rest.toml"), {**keys, "estimator": [estimator]}))
    aiding = {one.rpartition("/")[2] for one in result.dataset.groups if "innovations/" in one}
    assert aiding == {"gnss_position", "gnss_velocity", "magnetometer"}


def test_one_with_the_keys_of_a_magnetometer_is_told_where_it_is(scenario: Path) -> None:
    keys = {"sensors.radar": {"kind": "./radar.py:Compass", "rate_hz": 5}}
    result = run(Scenario.load(scenario.with_name("rest.toml"), keys))
    assert result.dataset["sensors/radar/field_b"].values.shape[1:] == (3,)


@pytest.mark.ci
def test_the_example_of_the_manual_aids_a_filter(scenario: Path, tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parents[2] / "docs/examples/radar.py", tmp_path)
    shutil.copy(scenario, tmp_path)
    aids = ["gnss", "magnetometer", "airspeed"]
    keys = {"duration_s": 40, "sensors.radar.noise_m": 0.1}
    without, beside = (
        run(Scenario.load(tmp_path / "own.toml", {**keys, "estimator[0].aids": given})).dataset["estimators/ins"]
        for given in (aids, [*aids, "radar"])
    )
    assert (beside["innovations/radar"]["outcome"] == 0).mean() > 0.98
    sigma = [float(np.sqrt(one["covariance"].values[-1, 2, 2])) for one in (without, beside)]  # of height
    assert sigma[1] < 0.5 * sigma[0]


@pytest.mark.parametrize("kind", ["ins", pytest.param("federated", marks=pytest.mark.ci)])
def test_a_run_with_the_example_of_the_manual_has_a_report(scenario: Path, tmp_path: Path, kind: str) -> None:
    """It ended in a TypeError: nobody knew what a sample of it would be."""
    shutil.copy(Path(__file__).parents[2] / "docs/examples/radar.py", tmp_path)
    shutil.copy(scenario.with_name("rest.toml"), tmp_path)
    own = {"name": "mine", "kind": kind} | (
        {"aids": ["gnss", "magnetometer", "radar"]}
        if kind == "ins"
        else {"locals": [{"name": "a", "aids": ["gnss", "magnetometer"]}, {"name": "b", "aids": ["radar"]}]}
    )
    result = run(Scenario.load(tmp_path / "rest.toml", {"duration_s": 20, "estimator": [own]}))
    page = report.write_report(result.dataset, result.metrics, tmp_path / "report").read_text("utf-8")
    assert "What own sensors measure is left out" in page
