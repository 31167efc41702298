"""A receiver whose position stands still, while its velocity is right, leads no filter astray."""

from __future__ import annotations

import pytest

from testbed import Scenario, run

AIDS = ["gnss", "barometer", "magnetometer", "airspeed"]
INS = {"name": "filter", "kind": "ins", "gust_mps": 1.0, "aids": AIDS}
LOCALS = [{"name": "gnss", "aids": AIDS[:2]}, {"name": "others", "aids": AIDS[1:]}]
FEDERATED = {"name": "filter", "kind": "federated", "gust_mps": 1.0, "locals": LOCALS}


@pytest.mark.ci
@pytest.mark.parametrize("estimator", [INS, FEDERATED], ids=["ins", "federated"])
@pytest.mark.parametrize("channel", ["fix", "position", "north"])
def test_it_is_not_believed(estimator: dict[str, object], channel: str) -> None:
    """After 30 s it was: an INS was 1.3 km off and a federated filter 1.2 km, over 200 times what they claimed."""
    stuck = {"sensor": "gnss", "channel": channel, "kind": "stuck", "window": [80, 140]}
    overrides = {"duration_s": 160, "estimator": [estimator], "fault": [stuck], "expect": {}}
    found = run(Scenario.load("u_turn", overrides)).metrics
    assert found["filter.position_horizontal_max_m"] < 100
    assert found["filter.position_horizontal_over_3sigma_max"] < 1


@pytest.mark.ci
@pytest.mark.parametrize("aids", [AIDS, AIDS[:3]], ids=["airspeed", "no airspeed"])
def test_it_is_not_believed_by_who_comes_by(aids: list[str]) -> None:
    """Loitering, a frozen place was inside the wide gate once a lap: 158 m off, 31 times the claimed 3 sigma."""
    stuck = {"sensor": "gnss", "channel": "position", "kind": "stuck", "window": [100, 300]}
    plan = [{"leg": "loiter", "radius_m": 250.0, "duration_s": 600}]
    ins = {"name": "filter", "kind": "ins", "aids": aids}
    overrides = {"plan": plan, "duration_s": 310, "estimator": [ins], "fault": [stuck], "expect": {}}
    found = run(Scenario.load("u_turn", overrides)).metrics
    assert found["filter.position_horizontal_over_3sigma_max"] < 1
