"""Anybody's estimator: found, checked, run beside ours, and contained when it fails."""

import json
import socket
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner
from worlds.loop import same

import testbed.__main__ as cli
from nav.samples import Estimate
from testbed import Scenario, plugins, run
from testbed.errors import UserError
from testbed.estimators.custom import CustomSection, build
from testbed.loop.loop import EVENTS_S
from testbed.many import campaign as campaigns
from testbed.many import check
from testbed.score import accuracy

EXAMPLES = Path(__file__).parents[2] / "docs/examples"
TEMPLATE = Path(__file__).parents[2] / "testbed/template/first.toml"
SHORT = {"duration_s": 12, "expect": {}}

MINE = """
import sys

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, field_validator, model_validator
from nav.samples import Estimate, GnssSample


class Mine:
    class Options(BaseModel):
        model_config = ConfigDict(extra="forbid")
        after_s: float = 1e9
        how: str = "raise"

        @field_validator("how")
        @classmethod
        def _known(cls, how):
            if how == "spoilt":
                raise ValueError("there is no such way")
            return how if how != "divide" else 1 / 0

    def __init__(self, rig, after_s, how):
        self.t, self.fix, self.after_s, self.how, self.times = 0.0, None, after_s, how, []
        assert rig.sensors["gnss"].errors().latency >= 0
        assert rig.tick_rate_hz == 200.0
        rig.sensors.clear()  # which are its own

    def propagate(self, imu):
        self.t = imu.t[-1]
        if self.t > self.after_s and self.how == "raise":
            raise RuntimeError("lost its way")
        if self.t > self.after_s and self.how == "exit":
            sys.exit(3)
        if self.t > self.after_s and self.how == "panic":
            raise type("Panic", (BaseException,), {})("in Rust")
        if self.t > self.after_s and self.how == "mute":
            raise type("Mute", (Exception,), {"__str__": lambda self: 1 / 0})
        if self.how == "spoil":
            imu.dtheta[:] = 0.0

    def update(self, sample):
        self.times.append(sample.t)
        assert self.times == sorted(self.times) and abs(sample.t - self.t) < 1e-6
        if isinstance(sample, GnssSample) and sample.has_fix:
            self.fix = sample

    def estimate(self):
        if self.fix is None:
            return Estimate.of(self.t)
        if self.t > self.after_s and self.how == "nan":
            return Estimate.of(self.t, q_nb=np.full(4, np.nan), lla=np.full(3, np.nan))
        if self.t > self.after_s and self.how == "shape":
            return Estimate.of(self.t, q_nb=np.zeros(3))
        if self.t > self.after_s and self.how == "type":
            return 3.0
        lla = np.array([self.fix.lat, self.fix.lon, self.fix.h])
        return Estimate.of(self.t, q_nb=np.array([1.0, 0, 0, 0]), lla=lla, v_n=self.fix.v_n)


class Loose(Mine):  # says nothing of keys that it does not have
    class Options(BaseModel):
        after_s: float = Field(1e9, alias="until_s", description="how long")
        how: str = Field(validation_alias=AliasChoices("way", "manner"))
        limit: float = 1.0

        @model_validator(mode="before")
        @classmethod
        def _renamed(cls, keys):
            return {"limit" if key == "bound" else key: value for key, value in keys.items()}

    def __init__(self, rig, after_s, how, limit):
        super().__init__(rig, after_s, f"{how} {after_s:g} {limit:g}")


class Open(Mine):
    class Options(BaseModel):
        model_config = ConfigDict(extra="allow")
        after_s: float = 1e9

    def __init__(self, rig, after_s, **more):
        super().__init__(rig, after_s, str(more))


class Bare:
    def __init__(self, rig):
        pass
"""
PORTED = """

class Ported(Mine):
    def __init__(self, rig, after_s, how):
        super().__init__(rig, after_s, how)
        import socket, weakref

        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        weakref.finalize(self, own.close)
        own.bind(("127.0.0.1", {port}))
"""


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: a scenario with ours and theirs, and their file beside it."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "filters.py").write_text(MINE)
    text = (Path(__file__).parents[2] / "scenarios/u_turn.toml").read_text("utf-8").partition("[expect]")[0]
    mine = '[[estimator]]\nname = "mine"\nkind = "./filters.py:Mine"\n'
    (folder / "own.toml").write_text(f"{text}\n{mine}", "utf-8")
    return folder


def flown(folder: Path, **options: object):
    keys = {f"estimator[1].{key}": value for key, value in options.items()}
    return run(Scenario.load(folder / "own.toml", SHORT | keys))


@pytest.fixture(scope="session")
def healthy(folder: Path):
    return flown(folder)


def ours(result) -> dict[str, np.ndarray]:
    return {name: one.values for name, one in result.dataset["estimators/ins"].data_vars.items()}


RESTLESS = """
import os
import numpy as np
from pydantic import BaseModel, model_validator


def move():
    os.chdir("/")
    np.seterr(all="raise")


class Mine:
    class Options(BaseModel):
        _moves = model_validator(mode="before")(lambda keys: move() or keys)

    def __init__(self, rig):
        move()

    propagate = update = estimate = None
"""


def test_one_that_changes_what_is_everybodys_as_it_is_made_changes_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "restless.py").write_text(RESTLESS)
    monkeypatch.chdir(tmp_path)
    before = np.geterr()
    loaded = Scenario.load(folder / "own.toml", SHORT | {"estimator[1].kind": "./restless.py:Mine"})
    with pytest.raises(UserError, match="lacks propagate, update, estimate"):
        run(loaded, out=Path("out"))
    assert (Path.cwd(), np.geterr()) == (tmp_path, before)


def test_it_runs_beside_ours_and_is_recorded(healthy) -> None:
    own, truth = healthy.dataset["estimators/mine"], healthy.dataset["truth"]
    assert own["time"].values[-1] == truth["time"].values[-1]
    north = np.abs(own["lat"].values - truth["lat"].values)[50:].max() * 6.37e6
    assert north < 15.0  # the last fix, carried on by the increments
    assert healthy.remarks[-1].startswith("mine: its errors are not scored")


@pytest.mark.ci
@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("raise", "RuntimeError: lost its way (filters.py, line"),
        ("exit", "SystemExit: 3 (filters.py, line"),
        ("panic", "Panic: in Rust (filters.py, line"),
        ("mute", "Mute: it can't be shown (filters.py, line"),
        ("shape", "estimate: q_nb has shape (3,), not (4,)"),
        ("type", "estimate gave 3.0, not a nav.samples.Estimate"),
    ],
)
def test_its_failure_ends_only_itself(folder: Path, healthy, how: str, says: str) -> None:
    """Told with its name; ours has the same bits as beside a sound one."""
    result = flown(folder, how=how, after_s=5.0)
    (remark,) = [one for one in result.remarks if "has ended" in one]
    assert remark.startswith(f"mine has ended: {says}")
    events = result.dataset["events"]
    (told,) = [text for text in events["text"].values.tolist() if "has ended" in text]
    assert told == remark
    assert f"mine has ended: {accuracy.ended(result.dataset)['mine']}" == remark
    assert np.isnan(result.dataset["estimators/mine/lat"].values[-1])
    before, after = ours(healthy), ours(result)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name], equal_nan=before[name].dtype.kind == "f") for name in before)


@pytest.mark.ci
def test_its_end_is_told_by_who_flies_many(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a campaign, of which the others' numbers are as good as ever; to a check it is a failure; by its record."""
    expected = 'expect={"ins.aligned_s"=60, "mine.aligned_s"=60}'
    overrides = ["duration_s=8", "estimator[1].after_s=5", expected]
    flown = partial(campaigns.fly, campaigns.Plan(folder / "own.toml", 1, tmp_path / "many", overrides=overrides))
    for result in (flown(), flown()):  # the second finds what the first has stored
        assert result.failures == []
        (told,) = result.spoilt()
        assert told.startswith("mine has ended in seed 1: RuntimeError: lost its way (filters.py, line")
        assert [one.share.value for one in result.statistics.expected] == [1.0, 0.0]
    (kept,) = json.loads((tmp_path / "many/campaign.json").read_text("utf-8"))["spoilt"]
    assert (kept["seed"], kept["estimator"]) == (1, "mine")
    assert kept["message"].startswith("RuntimeError: lost its way")
    assert "mine has ended: RuntimeError: lost its way" in (tmp_path / "many/report.html").read_text("utf-8")
    scenario = Scenario.load(folder / "own.toml", overrides)
    outcome = check.fly(check.Task("own", scenario, tmp_path / "one", None))
    assert [row.verdict for row in outcome.rows] == ["kept", "kept"]
    assert outcome.failed
    assert "FAILED" in str(outcome)
    assert "mine has ended: RuntimeError: lost its way (filters.py, line" in str(outcome)
    monkeypatch.setattr(cli, "conclude", lambda *_: None)  # figures take long
    again = CliRunner().invoke(cli.app, ["report", str(tmp_path / "one/run.nc")])
    assert "mine has ended: RuntimeError: lost its way (filters.py, line" in again.output


def test_what_it_does_to_its_samples_is_its_own_affair(folder: Path, healthy) -> None:
    result = flown(folder, how="spoil")
    assert not [one for one in result.remarks if "has ended" in one]
    before, after = ours(healthy), ours(result)
    assert all(np.array_equal(before[name], after[name], equal_nan=before[name].dtype.kind == "f") for name in before)


def test_same_bits_live_and_batch(folder: Path, healthy) -> None:
    live = run(Scenario.load(folder / "own.toml", SHORT), realtime=1000.0)
    assert same(healthy.dataset, live.dataset)


@pytest.mark.ci
@pytest.mark.parametrize("flies", ["truth", "ins"])
def test_its_end_is_told_at_the_same_time_live_and_batch(folder: Path, flies: str) -> None:
    """Where events are looked for, once its first estimate is missing, however long a turn is."""
    keys = SHORT | {"estimator[1].how": "raise", "estimator[1].after_s": 5.013, "autopilot.feedback": flies}
    scenario = Scenario.load(folder / "own.toml", keys)
    batch, live = run(scenario), run(scenario, realtime=1000.0)
    events, own = batch.dataset["events"], batch.dataset["estimators/mine"]
    (told,) = events["time"].values[["mine has ended" in text for text in events["text"].values.tolist()]]
    missing = own["time"].values[np.isnan(own["lat"].values) & (own["time"].values > 5.0)][0]
    assert missing <= told <= missing + EVENTS_S
    assert same(batch.dataset, live.dataset)


def test_nan_is_never_flown_on(folder: Path) -> None:
    keys = {"estimator[1].how": "nan", "estimator[1].after_s": 1.0, "autopilot.feedback": "mine"}
    result = run(Scenario.load(folder / "own.toml", SHORT | keys))
    numbers = "lat, lon, h, v_north, v_east, v_down, roll, pitch, heading"
    assert result.failure == f"the autopilot lost its estimate: mine gives no {numbers}"
    assert np.isfinite(result.dataset["truth/lat"].values).all()


def test_it_flies_the_aircraft() -> None:
    """The one that `testbed init` writes estimates no biases: there are none to take off the rates."""
    result = run(Scenario.load(TEMPLATE, {"autopilot.feedback": "mine", "duration_s": 15, "expect": {}}))
    assert result.failure == ""
    told = result.dataset["events"]["text"].values.tolist()
    assert "the autopilot flies on mine from here on" in told
    assert result.dataset["truth/time"].values[-1] == 15.0


def test_an_estimate_is_made_of_what_is_given() -> None:
    """What is not given is unknown."""
    wind = np.array([3.0, 1.0]), np.array([0.5, 0.5])
    made = Estimate.of(1.0, gyro_bias=np.ones(3), accel_bias=np.zeros(3), extra={"wind": wind})
    assert made.gyro_bias.tolist() == [1.0, 1.0, 1.0]
    assert made.accel_bias.tolist() == [0.0, 0.0, 0.0]
    assert made.extra == {"wind": wind}
    assert np.isnan([made.lat, *made.q_nb, *made.sigma_gyro_bias, *made.sigma_accel_bias]).all()
    assert not Estimate.of(1.0).extra


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("filters", 'there is no kind "filters": choose from ins, federated, ahrs'),
        ("inss", "did you mean ins?"),
        ("./none.py:Mine", "can't be read: No such file or directory: a path is relative to the scenario file"),
        ("./filters.py:Mind", 'there is no class in ./filters.py "Mind": did you mean Mine?'),
        ("./filters.py:Nope", 'there is no class in ./filters.py "Nope": choose from Mine, Loose'),
        ("nowhere.filters:Mine", "there is no module nowhere.filters: install it, or give its file, such as"),
        ("./filters.py:Bare", "./filters.py:Bare lacks propagate, update, estimate"),
        ("math:pi", "math:pi can't be made: TypeError"),
        ("sys:exit", "sys:exit can't be made: SystemExit"),
    ],
)
def test_what_is_wrong_with_a_kind_is_said(folder: Path, kind: str, says: str) -> None:
    with pytest.raises(UserError) as told:
        flown(folder, kind=kind)
    assert says in str(told.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"after": 3}, "own.toml (--set estimator[1].after=3): estimator[1].after: unknown key: did you mean after_s?"),
        ({"after_s": "soon"}, "estimator[1].after_s: must be a valid number"),
        ({"how": "spoilt"}, "estimator[1].how: there is no such way"),
        ({"how": "divide"}, "ZeroDivisionError: division by zero (filters.py, line"),
        ({"aids": ["gnss2"]}, 'there is no sensor "gnss2"'),
        ({"imu": "gnss"}, 'there is no IMU "gnss"'),
    ],
)
def test_what_is_wrong_with_its_keys_is_said(folder: Path, options: dict[str, object], says: str) -> None:
    with pytest.raises(UserError) as told:
        flown(folder, **options)
    assert says in str(told.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"way": "", "until": 3}, "estimator[1].until: unknown key: did you mean until_s? Choose from name, kind,"),
        ({"way": "", "after_s": 3}, "estimator[1].after_s: unknown key: choose from name, kind,"),
        ({"until_s": 3}, "estimator[1].way: is missing: add it"),
    ],
)
def test_a_key_that_its_options_do_not_have_is_said(folder: Path, options: dict[str, object], says: str) -> None:
    """Pydantic dropped it, and the run went on without what was meant."""
    with pytest.raises(UserError) as told:
        flown(folder, kind="./filters.py:Loose", **options)
    assert says in str(told.value)
    assert "after_s, how" not in str(told.value)  # which a file calls otherwise


def test_a_key_that_the_options_of_a_record_do_not_have_is_said(folder: Path) -> None:
    section = CustomSection(name="mine", kind="./filters.py:Loose", way="", limits=3)
    with pytest.raises(UserError, match=r"^estimator mine: limits: unknown key: did you mean limit\? Choose from"):
        build(section, SimpleNamespace(folder=folder))


@pytest.mark.parametrize(
    ("kind", "options", "how"),
    [
        ("Loose", {"until_s": 3, "manner": "so", "bound": 2}, "so 3 2"),
        ("Loose", {"way": "so", "limit": 4}, "so 1e+09 4"),
        ("Open", {"after_s": 3, "further": 4}, "{'further': 4}"),
    ],
)
def test_keys_that_its_options_have_by_other_names_are_taken(
    folder: Path, kind: str, options: dict[str, object], how: str
) -> None:
    """By an alias, by a validator of the model's, or any at all where it says so."""
    keys = {f"estimator[1].{key}": value for key, value in {"kind": f"./filters.py:{kind}", **options}.items()}
    scenario = Scenario.load(folder / "own.toml", SHORT | keys)
    lane = build(scenario.estimator[1], scenario.rig(1))
    assert lane.horizon.estimator.inner.how == how


def test_all_that_is_wrong_with_its_keys_is_said_with_its_line(folder: Path) -> None:
    text = (folder / "own.toml").read_text("utf-8").replace("seed = 1", "seeds = 1", 1)
    (folder / "wrong.toml").write_text(f"{text}after = 3\nafter_s = 'soon'\nhow = 3\n", "utf-8")
    first = text.count("\n") + 1
    with pytest.raises(UserError) as told:
        Scenario.load(folder / "wrong.toml")
    *others, after, after_s, how = str(told.value).splitlines()
    assert any("seeds: unknown key" in one for one in others)
    assert after.startswith(f"{folder}/wrong.toml:{first}: estimator[1].after: unknown key: did you mean after_s?")
    assert after_s.startswith(f"{folder}/wrong.toml:{first + 1}: estimator[1].after_s: must be a valid number")
    assert how.startswith(f"{folder}/wrong.toml:{first + 2}: estimator[1].how: must be")
    Scenario.parse(text.replace("seeds", "seed") + "after = 3\n", [], folder / "wrong.toml")  # as of a record


def test_a_file_that_does_not_run_says_where(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("x = 1\ny = 1 / 0\n")
    with pytest.raises(
        UserError, match=r"can't be imported: ZeroDivisionError: division by zero \(broken.py, line 2\)"
    ):
        plugins.load("./broken.py:Mine", tmp_path, "none")
    (tmp_path / "half.py").write_text("class A(:\n")
    with pytest.raises(UserError, match=r"SyntaxError: invalid syntax \(half.py, line 1\)$"):
        plugins.load("./half.py:A", tmp_path, "none")


def test_every_kind_that_cannot_be_had_is_told_with_its_line(folder: Path) -> None:
    text = (folder / "own.toml").read_text("utf-8").replace("filters.py:Mine", "none.py:Mine")
    text += '[[estimator]]\nname = "two"\nkind = "./filters.py:Nope"\n'
    (folder / "wrong.toml").write_text(text, "utf-8")
    first, second = (n for n, line in enumerate(text.splitlines(), 1) if line.startswith('kind = "./'))
    with pytest.raises(UserError) as told:
        Scenario.load(folder / "wrong.toml")
    one, two = str(told.value).splitlines()
    assert one.startswith(f'{folder}/wrong.toml:{first}: estimator[1].kind: kind "./none.py:Mine": ')
    assert two.startswith(f'{folder}/wrong.toml:{second}: estimator[2].kind: kind "./filters.py:Nope": there is no')
    Scenario.parse(text, [], folder / "wrong.toml")  # as of a record, which needs no class


def test_an_installed_package_offers_a_kind_by_name(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setattr(plugins, "installed", lambda group: {"theirs": "filters_installed:Mine"})
    monkeypatch.syspath_prepend(str(folder))
    (folder / "filters_installed.py").write_text(MINE)
    assert flown(folder, kind="theirs").dataset["estimators/mine"]["time"].size


@pytest.mark.ci
def test_one_that_holds_a_port_keeps_to_the_clock_too(folder: Path) -> None:
    """It is made once before, so that all is loaded, and that one held the port until the end of the run."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (folder / "ported.py").write_text(MINE + PORTED.format(port=port))
    keys = {"duration_s": 2, "expect": {}, "estimator[1].kind": "./ported.py:Ported"}
    result = run(Scenario.load(folder / "own.toml", keys), realtime=20.0)
    assert not result.ended


# --- the examples of the manual


def example(file: str, kind: str, **keys: object):
    text = (Path(__file__).parents[2] / "scenarios/u_turn.toml").read_text("utf-8").partition("[[estimator]]")[0]
    own = f'[[estimator]]\nname = "own"\nkind = "./{file}:{kind}"\n'
    scenario = Scenario.parse(f"{text}\n{own}", [], EXAMPLES / "own.toml")
    return run(Scenario.parse(text + own, overrides(keys), EXAMPLES / "own.toml")), scenario


def overrides(keys: dict[str, object]) -> list[str]:
    from testbed.scenario import keypath

    return [keypath.override(f"estimator[0].{key}", value) for key, value in keys.items()]


@pytest.mark.ci
def test_complementary() -> None:
    result, _ = example("complementary.py", "Complementary", estimates="attitude", time_constant_s=20.0)
    print(result.metrics)
    assert result.metrics["own.roll_pitch_rms_deg"] < 8.0  # gravity is not down in a turn
    assert "own.attitude_nees_mean" not in result.metrics


@pytest.mark.ci
def test_published() -> None:
    pytest.importorskip("vqf")
    result, _ = example("published.py", "Published", estimates="attitude")
    print(result.metrics)
    assert result.metrics["own.roll_pitch_rms_deg"] < 8.0


@pytest.mark.ci
def test_external() -> None:
    command = [sys.executable, "external_filter.py"]  # beside the scenario
    result, _ = example("external.py", "External", command=command)
    print(result.metrics)
    assert result.metrics["own.position_horizontal_rms_m"] < 10.0
    assert not [one for one in result.remarks if "has ended" in one]


def answering(answer: str) -> list[str]:
    return [sys.executable, "-c", f"import sys\nfor line in sys.stdin:\n if line == 'estimate\\n': {answer}"]


@pytest.mark.ci
@pytest.mark.parametrize(("command", "says"), [
    (answering("print('oops', flush=True)"), "RuntimeError: the program has answered 'oops\\n' (external.py, line "),
    (answering("print('1 1 0 0', flush=True)"), "the program has answered 2 numbers of its state, not 10: '1 1 0 0"),
    (answering("break"), "the program has ended with exit code 0"),
    ([sys.executable, "-c", "raise SystemExit(3)"], "the program has ended with exit code 3"),
    (answering("print(end='', flush=True)"), "the program has not answered for 0.5 s"),
    (answering("print('0.0 0 nan', end='', flush=True)"), "the program has not answered for 0.5 s"),
    ([sys.executable, "-c", "import os, time; os.close(1); time.sleep(99)"], "the program has ended with exit code -9"),
    (["yes"], "the program has answered 'y\\n'"),
])  # fmt: skip
def test_what_is_wrong_with_an_external_program_is_said(
    command: list[str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules[plugins.load("./external.py:External", EXAMPLES, "none").__module__]
    monkeypatch.setattr(module, "ANSWER_S", 0.5)
    result, _ = example("external.py", "External", command=command)
    (ended,) = [one for one in result.remarks if "has ended" in one]
    assert says in ended


def test_the_command_of_an_external_program_is_a_list() -> None:
    with pytest.raises(
        UserError, match=r"ValueError: command is a list: .*, such as \['python', 'external_filter.py'\]"
    ):
        example("external.py", "External", command="python external_filter.py")


@pytest.mark.ci
def test_an_external_program_that_does_not_know_is_not_aligned() -> None:
    result, _ = example("external.py", "External", command=answering("print(*[float('nan')] * 12, flush=True)"))
    assert not [one for one in result.remarks if "has ended" in one]
    assert "own.aligned_s" not in result.metrics


@pytest.mark.ci
def test_an_external_program_that_hangs_does_not_outlive_the_run() -> None:
    made = plugins.load("./external.py:External", EXAMPLES, "none")
    own = made(SimpleNamespace(folder=EXAMPLES), [sys.executable, "-c", "import time; time.sleep(100)"])
    program = own.program
    own.tell("barometer", 0.0, 1e5)
    del own
    assert program.returncode is not None


def test_options_of_a_type_that_is_not_there_yet_are_told_on_a_readable_line(tmp_path: Path) -> None:
    """Inside its class a name of the class itself means nothing; pydantic says what to do, in lines of its own."""
    (tmp_path / "own.py").write_text(
        "from pydantic import BaseModel\n\n\nclass Mine:\n"
        "    class Tuning(BaseModel):\n        gain: float = 1.0\n\n"
        '    class Options(BaseModel):\n        tuning: "Mine.Tuning"\n'
    )
    text = (Path(__file__).parents[2] / "scenarios/u_turn.toml").read_text("utf-8").partition("[[estimator]]")[0]
    (tmp_path / "a.toml").write_text(f'{text}[[estimator]]\nname = "mine"\nkind = "./own.py:Mine"\ntuning = {{}}\n')
    with pytest.raises(UserError) as refused:
        Scenario.load(tmp_path / "a.toml")
    todo = "you should define `Mine`, then call `Options.model_rebuild()`. For further information visit https://"
    assert todo in str(refused.value)


def test_a_run_of_what_was_edited_since_it_was_imported_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It flew the old code without a word, and its record could not tell that it was another's."""
    (tmp_path / "idling.py").write_text(
        "class Idle:\n"
        "    def __init__(self, rig): self.t = 0.0\n"
        "    def propagate(self, imu): self.t = float(imu.t[-1])\n"
        "    def update(self, sample): return []\n"
        "    def estimate(self):\n"
        "        from nav.samples import Estimate\n"
        "        return Estimate.of(self.t)\n"
    )
    (tmp_path / "own.toml").write_text(
        'title = "Idle"\nseed = 1\nduration_s = 1\n[truth]\nsource = "kinematic"\nmotion = "static"\n'
        "start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 300 }\n[sensors.imu]\n"
        '[[estimator]]\nname = "idle"\nkind = "idling:Idle"\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    scenario = Scenario.load(tmp_path / "own.toml")
    first = run(scenario)
    assert "own_code" in first.dataset.attrs
    assert not any("edited" in one for one in first.remarks)
    with (tmp_path / "idling.py").open("a") as file:
        file.write("# more\n")
    assert any("idling.py: has been edited since it was imported" in one for one in run(scenario).remarks)
