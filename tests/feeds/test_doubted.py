"""The heading of an autopilot's own solution is checked, whatever the wind, wherever anything tells."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from worlds.log_writers import dataflash, us

from testbed.feeds import formats

SECONDS, IMU_HZ, GNSS_HZ, SPEED = 60.0, 50, 5, 20.0


def remark(folder: Path, turn: float, off_deg: float, crab_deg: float, since: float = 0.0) -> str:
    """Of a log of level circles, or a straight flight; its nose ``crab_deg`` right of its course.

    Its heading is thought to be ``off_deg`` more than that from a time on [s].
    """
    crab = math.radians(crab_deg)
    found: list[tuple[str, tuple[Any, ...]]] = []
    for k in range(1, int(SECONDS * IMU_HZ) + 1):
        t = k / IMU_HZ
        course = turn * t
        shaken = 0.5 * (-1) ** k  # or it would be taken for at rest
        inwards = SPEED * turn
        force = inwards * math.sin(crab) + shaken, inwards * math.cos(crab), -9.81
        found.append(("IMU", (us(t), 0, 0.0, 0.0, turn, *force)))
        if k % (IMU_HZ // GNSS_HZ):
            continue
        north = SPEED / turn * math.sin(course) if turn else SPEED * t
        east = SPEED / turn * (1 - math.cos(course)) if turn else 0.0
        place = 47 + math.degrees(north / 6.378e6), 8 + math.degrees(east / 6.378e6) / math.cos(math.radians(47)), 500.0
        told = us(t), 0, 3, 100_000_000 + round(t * 1e3), 1820, 10, 1.0
        found.append(("GPS", (*told, *place, SPEED, math.degrees(course) % 360, 0.0)))
        heading = (math.degrees(course + crab) + (off_deg if t > since else 0.0)) % 360
        velocity = SPEED * math.cos(course), SPEED * math.sin(course), 0.0
        found += [("XKF1", (us(t), 0, 0.0, 0.0, heading, *velocity)), ("POS", (us(t), *place))]
    return formats.read(dataflash(found, folder / "flight.bin"), {}).remark


@pytest.mark.parametrize("crab_deg", [0.0, 40.0, -90.0])
@pytest.mark.parametrize(("off_deg", "since"), [(60.0, 0.0), (-60.0, 38.0)])
def test_a_heading_that_is_off_is_told(off_deg: float, since: float, crab_deg: float, tmp_path: Path) -> None:
    said = remark(tmp_path, 0.15, off_deg, crab_deg, since)
    how = "by how gnss and the accelerometers tell the same turns: judge no attitude by it"
    assert said == f"the heading of the autopilot's own solution (XKF1) is 60 deg off at times, {how}"


@pytest.mark.parametrize(
    ("turn", "off_deg", "crab_deg"), [(0.15, 0.0, 0.0), (0.15, 0.0, 60.0), (-0.15, 20.0, 0.0), (0.0, 60.0, 0.0)]
)
def test_a_heading_that_wind_explains_or_nothing_tells_is_not(
    turn: float, off_deg: float, crab_deg: float, tmp_path: Path
) -> None:
    assert remark(tmp_path, turn, off_deg, crab_deg) == ""
