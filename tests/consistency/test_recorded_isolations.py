"""Healthy recorded flights in a federation with every detector: how often a sound sensor is isolated.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_isolations.py`` prints the table.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from worlds import real_flights

from nav.federated import Federated
from testbed import Scenario, run
from testbed.estimators import registry
from testbed.estimators.lane import Lane

FLOWN = {"thor": (155.0, 518.0), "swiss": (25.0, 149.0), "quad": (60.0, 690.0)}  # in the air [s of the run]
# Isolations of a flight, of all its six federations together: what was measured.
MOST = {"thor": 0, "swiss": 0, "quad": 0}


def federation(name: str, structure: str, detector: str) -> str:
    """A receiver, air data and a magnetometer, a local filter each."""
    text = real_flights.FLIGHTS[name].partition("[[estimator]]")[0]
    air = ["barometer"] if name == "quad" else ["barometer", "airspeed"]
    text += f'[[estimator]]\nname = "federated"\nkind = "federated"\nstructure = "{structure}"\n'
    for local, aids in (("gnss", ["gnss"]), ("air", air), ("magnetometer", ["magnetometer"])):
        text += f'[[estimator.locals]]\nname = "{local}"\naids = {aids}\ndetector = {{ kind = "{detector}" }}\n'
    return text


def isolations(path: Path, begin: float, end: float) -> list[str]:
    """Parts isolated between two times."""
    lanes: dict[str, Lane] = {}
    original = registry.build

    def build(*arguments):
        lanes.update(original(*arguments))
        return lanes

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "build", build)
        run(Scenario.load(path, {"truth.reference": "gnss"}))
    federated = lanes["federated"].horizon.estimator
    assert isinstance(federated, Federated)
    found, before = [], {}
    for event in federated.events:
        was = before.get(event[1:4], (False,) * len(event.isolated))
        new = any(here and not there for here, there in zip(event.isolated, was, strict=True))
        before[event[1:4]] = event.isolated
        if new and begin <= event.t <= end:
            found.append(event.part)
    return found


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", FLOWN)
def test_sound_sensors_are_kept(name: str, tmp_path: Path) -> None:
    begin, end = FLOWN[name]
    total = 0
    for structure in ("full_reset", "no_reset"):
        for detector in ("chi_square", "sprt", "glr"):
            path = tmp_path / f"{structure}_{detector}.toml"
            path.write_text(federation(name, structure, detector), "utf-8")
            found = isolations(path, begin, end)
            total += len(found)
            print(f"{name}, {structure}, {detector}: {len(found) * 3600 / (end - begin):.0f} per hour {found}")
    assert total <= MOST[name]
