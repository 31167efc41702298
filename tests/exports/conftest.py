"""One short flight with several sensors of a kind, an outage, and an estimator of attitude alone, for all formats."""

from pathlib import Path

import pytest

from testbed import Scenario, run

CHANGES = {
    "duration_s": 40,
    "sensors.imu.lever_arm_m": [0.2, 0.1, -0.1],
    "sensors.gnss.lever_arm_m": [0.5, 0.0, -0.3],
    "sensors.gnss.latency_s": 0.12,
    "sensors.gnss.denied": [[25, 30]],
    "sensors.second": {"kind": "gnss", "grade": "rtk", "rate_hz": 1, "denied": [[26, 32]]},
}
AHRS = '\n[[estimator]]\nname = "level"\nkind = "ahrs"\naids = ["magnetometer"]\n'


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record."""
    folder = tmp_path_factory.mktemp("flown")
    text = Scenario.load("kinematic_u_flight").text.replace("\n[expect]", f"{AHRS}\n[expect]")
    scenario = Scenario.parse(text).changed(CHANGES)
    run(scenario, out=folder)
    return folder / "run.nc"
