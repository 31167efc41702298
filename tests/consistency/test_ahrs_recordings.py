"""The attitude filter that levels in any motion, on recordings that are not part of the project.

`worlds.broad` and `worlds.real_flights` say what lies where. The configuration was chosen on the trials of BROAD that
are named `CHOSEN_ON` and on the aeroplane's and the quadcopter's flights; the others were looked at twice.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import broad, real_flights

from testbed import Scenario, run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings"),
]
CHOSEN_ON = {"03", "11", "16", "24", "31", "34"}


def test_broad() -> None:
    """Not behind VQF over all trials, by one configuration, and claiming what it errs."""
    rows, mean = [], []
    for path in broad.trials():
        trial = broad.read(path)
        at, q, covariance = broad.estimates(trial, broad.config(1 / trial.dt).in_any_motion())
        scored = trial.scored[at] & np.isfinite(q).all(axis=1)
        true = trial.true[at][scored]
        ours = broad.rms(broad.error(q[scored], true))
        theirs = broad.rms(broad.error(broad.vqf(trial)[trial.scored], trial.true[trial.scored]))
        tilt, heading = broad.nees(q[scored], true, covariance[scored])
        mean.append([*ours, *theirs, tilt, heading])
        rows.append((trial.name, "chosen on" if trial.name[:2] in CHOSEN_ON else "aside", mean[-1]))
    form = "{:48s} {:9s} ours {:5.2f} {:5.2f} {:5.2f}  VQF {:5.2f} {:5.2f} {:5.2f}  NEES tilt {:4.2f} heading {:4.2f}"
    for name, part, figures in rows:
        print(form.format(name, part, *figures))
    for part in ("chosen on", "aside"):
        print(form.format("mean", part, *np.mean([figures for _, which, figures in rows if which == part], axis=0)))
    overall = np.mean(mean, axis=0)
    print(form.format("mean", "all", *overall))
    assert overall[0] <= overall[3]  # total
    assert overall[2] <= 1.25 * overall[5]  # inclination
    assert overall[6] < 1.0
    # a telephone at the sensor turns the field by 6 deg for all of a trial: nothing on board tells
    assert np.median([figures[7] for *_, figures in rows]) < 1.0
    assert max(figures[2] for _, _, figures in rows) < 2.0


@pytest.mark.parametrize("name", ["thor", "quad"])
def test_flights(name: str, tmp_path: Path) -> None:
    """Within 3 deg of the attitude on board, and less than half of what low dynamics alone give."""
    head, ahrs = real_flights.FLIGHTS[name].split('[[estimator]]\nname = "ins"')
    told = ahrs[ahrs.index("[[estimator]]") :]
    path = tmp_path / "flight.toml"
    path.write_text(head + told + told.replace('"ahrs"\nkind', '"any"\nprofile = "any_motion"\nkind'), "utf-8")
    scores = run(Scenario.load(path), out=tmp_path).metrics
    print(name, {key: round(value, 2) for key, value in scores.items() if "roll_pitch" in key or "nees" in key})
    assert scores["any.roll_pitch_rms_deg"] < {"thor": 3.0, "quad": 1.0}[name]
    assert scores["any.roll_pitch_rms_deg"] < 0.5 * scores["ahrs.roll_pitch_rms_deg"]
