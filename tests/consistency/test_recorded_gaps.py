"""Recorded flights that lack a stretch, as when a logger stalls: how soon a filter is right again, and its claim.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_gaps.py`` prints the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import real_flights

from nav.earth import displacement_n
from testbed import Scenario, run

FILES = {"thor": "fw_thor75", "swiss": "fw_px4_swisslog", "quad": "mr_quad123"}
# What has a time of its own, and the values that it is of; and where the scenario begins in the recording [s].
STREAMS = {
    "imu_t": ("gyro", "accel"), "gnss_t": ("gnss_lat", "gnss_lon", "gnss_h", "gnss_vel", "gnss_nsat"),
    "air_t": ("p_static", "ias", "baro_h", "baro_h_rel"), "mag_t": ("mag", "mag_raw"),
}  # fmt: skip
BEGINS = {"thor": 60.0, "swiss": 0.0, "quad": 0.0}
STARTS = {"thor": (180, 230, 280, 330, 380), "swiss": (35, 55, 75, 95), "quad": (80, 200, 320, 440, 560)}
GAPS_S = (3.0, 10.0, 30.0)
AFTER_S = (1, 2, 3, 5, 10, 20)


def cut(name: str, first: float, last: float, folder: Path) -> Scenario:
    """A flight without what was measured from ``first`` to ``last`` [s of the run]."""
    whole = dict(np.load(Path(real_flights.FOLDER) / f"{FILES[name]}.npz"))
    for time, values in STREAMS.items():
        t = whole[time] - BEGINS[name]
        kept = (t <= first) | (t > last)
        for column in (time, *(one for one in values if one in whole)):
            whole[column] = whole[column][kept]
    np.savez(folder / f"{FILES[name]}.npz", **whole)
    path = folder / "flight.toml"
    path.write_text(real_flights.FLIGHTS[name].replace(real_flights.FOLDER, str(folder)), "utf-8")
    return Scenario.load(path, {"truth.reference": "gnss"})


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", STARTS)
def test_after_a_gap_a_flight_is_right_in_three_seconds(name: str, tmp_path: Path) -> None:
    for gap in GAPS_S:
        rows = []
        for start in STARTS[name]:
            data = run(cut(name, start, start + gap, tmp_path)).dataset
            own, fixes = data["estimators/ins"], data["sensors/gnss"]
            place = np.array([own[key].values for key in ("lat", "lon", "h")])
            sigma = np.hypot(*own["sigma_position_n"].values[:, :2].T)
            for after in AFTER_S:
                k = int(np.abs(fixes["time"].values - (start + gap + after)).argmin())
                t = float(fixes["time"].values[k])
                here = [float(np.interp(t, own["time"].values, one)) for one in place]
                there = [float(fixes[key].values[k]) for key in ("lat", "lon", "h")]
                off = float(np.hypot(*displacement_n(*here, *there)[:2]))
                rows.append((off, float(np.interp(t, own["time"].values, sigma))))
        off, claimed = np.array(rows).reshape(-1, len(AFTER_S), 2).transpose(2, 1, 0)
        print(f"{name}: {AFTER_S} s after a gap of {gap:g} s: {off.max(axis=1).round(1)} m off at most, "
              f"{np.nanmax(off / claimed, axis=1).round(1)} times what is claimed")  # fmt: skip
        assert (off / claimed < 4).all()
        assert off[AFTER_S.index(2) :].max() < 20  # of the first, whose receiver speaks once a second
        assert off[AFTER_S.index(5) :].max() < 8
