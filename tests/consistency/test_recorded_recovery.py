"""Recorded flights that begin in the air with a compass that points elsewhere for twenty seconds: how soon it is found.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_recovery.py`` prints the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import real_flights

from nav.earth import displacement_n
from testbed import Scenario, run

# The recording, its field, and when the scenario begins in it [s].
STARTS = {
    "thor": ("fw_thor75", "mag_raw", (245.0, 300.0, 385.0, 455.0)),
    "swiss": ("fw_px4_swisslog", "mag", (35.0, 47.0, 75.0)),
    "quad": ("mr_quad123", "mag", (120.0, 400.0)),
}
TURNS_DEG, TURNED_S = (90, -90, 180), 20.0
LASTS_S, FOUND_S = 70.0, 20.0


def turned(name: str, turn_deg: float, start: float, folder: Path) -> Scenario:
    """A flight from ``start`` on, the field turned about the body's z axis by so much for `TURNED_S`."""
    file, column, _ = STARTS[name]
    whole = dict(np.load(Path(real_flights.FOLDER) / f"{file}.npz"))
    now = whole["mag_t"] < start + TURNED_S
    x, y = whole[column][now, 0], whole[column][now, 1]
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    whole[column][now, 0], whole[column][now, 1] = cos * x - sin * y, sin * x + cos * y
    np.savez(folder / f"{file}.npz", **whole)
    path = folder / "flight.toml"
    path.write_text(real_flights.FLIGHTS[name].replace(real_flights.FOLDER, str(folder)), "utf-8")
    return Scenario.load(path, {"truth.reference": "gnss", "truth.start_s": start, "duration_s": LASTS_S})


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", STARTS)
def test_a_heading_that_was_wrong_from_the_first_is_found(name: str, tmp_path: Path) -> None:
    worst, late = [], []
    for start in STARTS[name][2]:
        for turn in TURNS_DEG:
            data = run(turned(name, turn, start, tmp_path)).dataset
            own, fixes = data["estimators/ins"], data["sensors/gnss"]
            t = own["time"].values
            place = np.array([own[key].values for key in ("lat", "lon", "h")])
            begun = float(t[np.isfinite(place[0])][0])
            off = [
                (time, np.hypot(*displacement_n(*(np.interp(time, t, one) for one in place), *there)[:2]))
                for time, *there in zip(*(fixes[key].values for key in ("time", "lat", "lon", "h")), strict=True)
                if time > begun + 0.5
            ]
            worst.append(max(one for _, one in off))
            late.append(max(one for time, one in off if time > begun + FOUND_S))
    print(f"{name}: {np.round(worst, 1)} m off at most, {np.round(late, 1)} m from {FOUND_S:g} s on after it began")
    # A compass that was thought biased may lead astray once more, for some seconds.
    assert np.quantile(late, 0.9) < 10
