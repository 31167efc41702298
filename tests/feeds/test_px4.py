"""Of several topics in which PX4 logs a receiver."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds.log_writers import ULOG, ulog

from nav.samples import GnssSample
from testbed.feeds import formats
from testbed.feeds.px4 import placed

UTC = 1_700_000_000.0  # at 0 of the autopilot's clock [s since 1970]
RECEIVERS = ("sensor_gps", "vehicle_gps_position")


@pytest.mark.parametrize("told_by", RECEIVERS)
def test_the_heights_of_a_px4_solution_are_those_of_its_fixes(
    told_by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two topics one has no heights above the ellipsoid: they were 47 m apart."""
    gps = ULOG["vehicle_gps_position"]
    monkeypatch.setitem(ULOG, "sensor_gps", gps)
    messages: list[tuple[str, tuple[Any, ...]]] = []
    for k in range(1, 101):
        t = 10_000 * k
        messages.append(("vehicle_imu", (t, 0.0, 0.0, 0.0, 0.0, 0.0, -0.098, 10_000, 10_000)))
        messages.append(("vehicle_attitude", (t, 1.0, 0.0, 0.0, 0.0)))
        messages.append(("vehicle_local_position", (t, 47.0, 8.0, 510.0, *[0.0] * 6)))
        for topic in RECEIVERS:
            ellipsoid = 557_000 if topic == told_by else 0
            place = 470_000_000, 80_000_000, 510_000, ellipsoid
            messages.append((topic, (t, *place, 0.3, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 3, 9)))
    log = formats.read(ulog(messages, tmp_path / "flight.ulg"), {})
    assert log.solution is not None
    assert log.messages.keys() >= set(RECEIVERS)
    assert np.nanmedian(log.solution.columns["h"]) == pytest.approx(557.0, abs=1e-3)
    for one in log.samples["gnss"]:
        assert isinstance(one, GnssSample)
        assert one.h == pytest.approx(557.0, abs=1e-3)


@pytest.mark.parametrize("fixed", [3, 10, 0])
def test_what_a_receiver_says_of_the_time_counts_once_it_has_a_fix(
    fixed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, it may be what its clock was set to; where it never has one, that is all that there is."""
    fields, layout = ULOG["vehicle_gps_position"]
    monkeypatch.setitem(ULOG, "vehicle_gps_position", (f"{fields}uint64_t time_utc_usec;", f"{layout}Q"))
    messages: list[tuple[str, tuple[Any, ...]]] = []
    for k in range(1, 11):
        t, has_fix = 100_000 * k, k > 10 - fixed
        utc = t + round(1e6 * (UTC if has_fix else 1e9))
        messages.append(("vehicle_imu", (t, 0.0, 0.0, 0.0, 0.0, 0.0, -0.98, 100_000, 100_000)))
        place = 470_000_000, 80_000_000, 510_000, 557_000
        said = (t, *place, 0.3, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 3 if has_fix else 0, 9, utc)
        messages.append(("vehicle_gps_position", said))
    assert formats.read(ulog(messages, tmp_path / "flight.ulg"), {}).utc == pytest.approx(UTC if fixed else 1e9)


def test_local_positions_are_on_px4s_sphere() -> None:
    """They were read as metres over the ellipsoid: 0.3 % of the way east, 30 m after 10 km."""
    north, east = np.array([0.0, 11119.49, 4.840]), np.array([0.0, 0.0, 7583.47])  # a tenth of a degree each, by hand
    lat, lon = placed(north, east, np.full(3, np.radians(47.0)), np.full(3, np.radians(8.0)))
    np.testing.assert_allclose(np.degrees(lat), [47.0, 47.1, 47.0], atol=1e-7)
    np.testing.assert_allclose(np.degrees(lon), [8.0, 8.0, 8.1], atol=1e-7)
    far = placed(np.array([0.0]), np.array([2.0e4]), np.array([0.8]), np.array([np.pi - 1e-6]))
    assert -np.pi < far[1][0] < -3.13  # over the date line
