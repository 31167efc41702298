"""What is known of an aircraft beside its XML: read, checked, and found by name or by path."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from testbed.errors import UserError
from testbed.motion import aircraft
from testbed.motion.model import Aircraft
from testbed.scenario import Scenario

SCENARIO = """
title = "a short flight"
duration_s = 100
[truth]
source = "flight"
aircraft = "{aircraft}"
start = {{ lat_deg = 47.0, lon_deg = 8.0, alt_m = 600, heading_deg = 0, airspeed_mps = 18 }}
[[plan]]
leg = "straight"
length_m = 1000
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """The flying wing under another name, in a folder of the user's."""
    folder = tmp_path / "mine"
    shutil.copytree(aircraft.folder("flying_wing"), folder)
    (folder / "flying_wing.xml").rename(folder / "mine.xml")
    return folder


def test_shipped_envelopes_are_read() -> None:
    assert set(aircraft.shipped()) == {"loiter", "flying_wing"}
    for name in aircraft.shipped():
        envelope = aircraft.load(name)
        assert envelope.airspeed.stall_mps < envelope.min_airspeed(0.0) < envelope.max_airspeed(0.0)
        assert 0 < envelope.bank_limit(envelope.usual.airspeed_mps, 300.0) <= envelope.max_bank


def test_a_mark_of_the_byte_order_is_no_matter(mine: Path) -> None:
    """Some editors begin every file with it."""
    file = mine / "envelope.toml"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert aircraft.load(str(mine)) == aircraft.load("flying_wing")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("stall_mps = 9.6", "", "airspeed.stall_mps: is missing: add it"),
        ("stall_mps = 9.6", 'stall_mps = "9.6"', "airspeed.stall_mps: "),
        ("stall_mps = 9.6", "stall_mps = -9.6", "airspeed.stall_mps: must be greater than 0"),
        ("stall_mps = 9.6", "stall_mps = nan", "airspeed.stall_mps: must be a finite number"),
        ("stall_mps = 9.6", "stal_mps = 9.6", "airspeed.stal_mps: unknown key"),
        ("max_mps = 25.0", "max_mps = 11.9", "airspeed.max_mps: must be above margin times stall_mps, 12.0"),
        ("ceiling_m = 3000.0", "ceiling_m = 20.0", "altitude.ceiling_m: must be above floor_m, 30"),
        ("none_below_mps = 11.2", "none_below_mps = 26", "climb.none_below_mps: must lie between"),
        ("airspeed_mps = 18.0", "airspeed_mps = 11.0", "usual.airspeed_mps: must be flown, from 12.0 to 25"),
        ("rate_mps = 3.5", "rate_mps = 0.1", "climb.rate_mps: leaves no climb at usual.airspeed_mps, 18"),
        ("speed_mps = 13.0", "speed_mps = 9.5", "launch.speed_mps: must be flown, from airspeed.stall_mps, 9.6"),
        ("turn_rate_radps = 0.08", "turn_rate_radps = 0.6", "usual.turn_rate_radps: at most 0.46 can be turned"),
        ("[climb]", "[climb", "can't be read: "),
    ],
)
def test_a_wrong_envelope_is_told_with_file_and_key(mine: Path, old: str, new: str, says: str) -> None:
    file = mine / "envelope.toml"
    text = file.read_text("utf-8")
    assert text.count(old) == 1
    file.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(UserError) as told:
        aircraft.load(str(mine))
    assert f"{file}: {says}" in str(told.value)


@pytest.mark.parametrize("lacking", ["mine.xml", "envelope.toml"])
def test_a_folder_that_is_no_aircraft_is_told(mine: Path, lacking: str) -> None:
    (mine / lacking).unlink()
    with pytest.raises(UserError, match=rf"{lacking}: is missing"):
        aircraft.load(str(mine))


@pytest.mark.ci
def test_a_model_that_jsbsim_cannot_fly_is_told(mine: Path) -> None:
    model = mine / "mine.xml"
    text = model.read_text("utf-8")
    head, _, rest = text.partition('<system file="autopilot">')
    model.write_text(head + rest.partition("</system>")[2], "utf-8")
    with pytest.raises(UserError, match=r"mine.xml: JSBSim can.t read it: .*fcs/aileron-pos-rad"):
        Aircraft(str(mine), 200.0)
    model.write_text(text.replace("brushless_700kv", "steam"), "utf-8")
    with pytest.raises(UserError, match=r"mine.xml: JSBSim can't read it"):
        Aircraft(str(mine), 200.0)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("</fdm_config>", "", "line {last} XML parse error: no element found"),
        ("<metrics>", "<metric>", "line {metrics} XML parse error: mismatched tag"),
    ],
)
def test_a_damaged_model_is_told_in_jsbsim_s_words(mine: Path, old: str, new: str, says: str) -> None:
    """A traceback's text stood there."""
    model = mine / "mine.xml"
    text = model.read_text("utf-8")
    model.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(UserError) as told:
        Aircraft(str(mine), 200.0)
    last = text.count("\n") + 1
    at = says.format(last=last, metrics=text[: text.index("</metrics>")].count("\n") + 1)
    assert str(told.value) == f"{model}: JSBSim can't read it: In file {model}: {at}"


def test_a_folder_is_seen_from_the_scenario_file(mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text(SCENARIO.format(aircraft="./mine"))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    scenario = Scenario.load(file)
    assert scenario.truth.aircraft == str(mine)  # type: ignore[union-attr]
    said = {"scenario": scenario.text, "overrides": "[]", "scenario_path": str(file)}
    assert Scenario.of_record(said).truth == scenario.truth
    monkeypatch.chdir(tmp_path)
    assert Scenario.parse(scenario.text).truth == scenario.truth
    assert Scenario.of_record({**said, "scenario_path": file.name}).truth == scenario.truth  # of an older record
    shutil.rmtree(mine)
    with pytest.raises(UserError, match=r'truth\.aircraft: there is no aircraft "./mine".* path of its folder'):
        Scenario.of_record(said)


def test_what_an_aircraft_can_fly_is_its_own(mine: Path, tmp_path: Path) -> None:
    """18 m/s: the flying wing's usual speed, below the stall margin of the loiter aircraft."""
    file = tmp_path / "scenario.toml"
    file.write_text(SCENARIO.format(aircraft="loiter"))
    with pytest.raises(UserError, match=r"truth\.start\.airspeed_mps: 18 m/s .* too near the stall"):
        Scenario.load(file)
    file.write_text(SCENARIO.format(aircraft="mine"))
    Scenario.load(file)
    (mine / "envelope.toml").unlink()
    with pytest.raises(UserError, match=r"truth\.aircraft: .*envelope.toml: is missing"):
        Scenario.load(file)


def test_the_digest_is_of_every_file(mine: Path) -> None:
    before = aircraft.digest(str(mine))
    assert before == aircraft.digest(str(mine))
    (mine / "envelope.toml").write_text((mine / "envelope.toml").read_text("utf-8") + "\n", "utf-8")
    assert aircraft.digest(str(mine)) != before
