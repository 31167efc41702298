"""A recorded quadcopter without its magnetometer: the heading that its accelerations tell, and what becomes of it.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_headings.py`` prints the figures. The
reference for the heading is the autopilot's, which has a compass.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from worlds import real_flights

from testbed import Scenario, run

WITHOUT = real_flights.flown_with("gnss", "barometer").partition('[[estimator]]\nname = "ahrs"')[0]


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
def test_a_quadcopter_without_its_magnetometer_finds_its_heading(tmp_path: Path) -> None:
    text = real_flights.FLIGHTS["quad"].partition("[sensors.imu]")[0]
    columns, _, reference = text.partition("[truth.columns.magnetometer]")
    reference = reference[reference.index("[truth.columns.reference]") :]
    path = tmp_path / "flight.toml"
    path.write_text(columns + reference + WITHOUT, "utf-8")
    found = run(Scenario.load(path, {"truth.reference": "gnss"})).metrics
    shown = {
        "aligned after [s]": found["ins.aligned_s"],
        "horizontal error, RMS [m]": found["ins.position_horizontal_rms_m"],
        "heading error, RMS and largest [deg]": (found["ins.heading_rms_deg"], found["ins.heading_max_deg"]),
        "tilt error, RMS [deg]": found["ins.roll_pitch_rms_deg"],
        "NEES of the attitude": found["ins.attitude_nees_mean"],
    }
    print(shown)
    assert found["ins.aligned_s"] < 30
    assert found["ins.position_horizontal_rms_m"] < 1.5
    assert found["ins.heading_max_deg"] < 25
    assert found["ins.attitude_nees_mean"] < 3
