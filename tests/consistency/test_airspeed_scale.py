"""Turbulence teaches a filter nothing wrong about its pitot tube: the scale that it finds has no mean error.

An aircraft turns into gusts from the side, which a constraint of no sideslip must not take for news of the airspeed.
"""

import numpy as np
import pytest
from scipy.stats import t as student

from testbed import Scenario, run
from testbed.data import data_dir

SEEDS = range(734001, 734013)
OVERRIDES = [
    "duration_s=260",
    "sensors.gnss.denied=[]",
    "expect={}",
    "estimator=[{name='ins', kind='ins', wind_walk_mps_per_sqrt_s=0.0,"
    " aids=['gnss', 'barometer', 'magnetometer', 'airspeed']}]",
]


def scale_error(seed):
    """Estimated less true [1], at the end; true is what the tube made of the air along body x, whatever the cause."""
    dataset = run(Scenario.load(data_dir("scenarios") / "loiter_gnss_outage.toml", OVERRIDES), seed=seed).dataset
    truth, sensed = dataset["truth"], dataset["sensors/airspeed"]
    at = truth.sel(time=sensed["time"], method="nearest")
    density = at["pressure"] / (287.05287 * at["temperature"])
    along = np.sqrt(density / 1.225) * at["airspeed"] * np.cos(at["alpha"]) * np.cos(at["beta"])
    true = float((sensed["eas"].values / along.values)[25:].mean()) - 1
    return float(dataset["estimators/ins"]["airspeed_scale"][-1]) - true


@pytest.mark.slow
def test_its_scale_has_no_mean_error():
    errors = np.array([scale_error(seed) for seed in SEEDS])
    mean, standard_error = errors.mean(), errors.std(ddof=1) / np.sqrt(len(errors))
    print(f"mean {mean:.4f}, standard error {standard_error:.4f}")
    assert abs(mean) < student.ppf(0.995, len(errors) - 1) * standard_error
