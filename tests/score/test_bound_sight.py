"""What the bound says of sensors that look at the ground, against the filters' own, which were written apart."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import xarray
from scipy.spatial.transform import Rotation

from nav.aids.terrain import optical_flow, range_to_ground
from nav.terrain import Terrain
from testbed import Scenario, run
from testbed.motion.sections import Terrain as Section
from testbed.score.bound_model import MOTION, Model
from testbed.score.bound_sight import add_sight
from testbed.sensors.optical_flow import OpticalFlowConfig
from testbed.sensors.rangefinder import RangefinderConfig

K = 6
RNG = np.random.default_rng(3)
ANGLES = RNG.uniform([-180, -20, -35], [180, 20, 35], (K, 3))
BODY = Rotation.from_euler("ZYX", ANGLES, degrees=True)
WAY = SimpleNamespace(
    t=np.arange(1.0, K + 1), T=np.ones(K), C_nb=BODY.as_matrix(), v_n=20 * RNG.normal(size=(K, 3)),
    omega_b=0.1 * RNG.normal(size=(K, 3)),
    lla=np.column_stack([np.full(K, 0.6), np.full(K, 1.9), RNG.uniform(300, 500, K)]),
)  # fmt: skip
GROUND = Section(height_m=50.0, map_sigma_m=5.0)


def jacobians(config: RangefinderConfig | OpticalFlowConfig) -> tuple[np.ndarray, Model]:
    model = Model(cast(Any, WAY))
    dataset = xarray.DataTree.from_dict({"/sensors/eye": xarray.Dataset(coords={"time": WAY.t})})
    assert add_sight(model, dataset, "eye", config, GROUND)
    ((_, rows),) = model.measurements
    return rows(slice(0, K), model.size)[0], model


@pytest.mark.parametrize("k", range(K))
def test_ranges(k: int) -> None:
    H, _ = jacobians(RangefinderConfig(grade="radar"))
    flat = Terrain.flat(50.0)
    q_nb = BODY[k].as_quat(scalar_first=True)
    _, own = range_to_ground(q_nb, WAY.lla[k], np.zeros(MOTION + 2), 9, -1, 10, 0.0, 400.0, flat.heights, flat.grid)
    np.testing.assert_allclose(H[k], own, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("k", range(K))
def test_flow(k: int) -> None:
    H, _ = jacobians(OpticalFlowConfig(grade="camera"))
    flat = Terrain.flat(50.0)
    q_nb = BODY[k].as_quat(scalar_first=True)
    _, own = optical_flow(
        q_nb, WAY.v_n[k], WAY.lla[k], np.zeros(MOTION + 4), 9, -1, 10, 11, 0.0, np.zeros(2), WAY.omega_b[k, :2],
        flat.heights, flat.grid,
    )  # fmt: skip
    np.testing.assert_allclose(H[k], own, rtol=1e-9, atol=1e-4)  # of the scale, the Earth's turning


def test_both_see_the_same_ground() -> None:
    model = Model(cast(Any, WAY))
    none = xarray.DataTree()
    for config in (RangefinderConfig(), OpticalFlowConfig()):
        assert add_sight(model, none, "eye", config, GROUND)
    assert model.size == MOTION + 1 + 1 + 3
    assert not add_sight(model, none, "eye", RangefinderConfig(), Section(file="relief.hgt"))


@pytest.mark.ci
def test_a_run_with_eyes_has_a_bound_and_one_without_a_higher_one() -> None:
    changes = ["duration_s=150", "sensors.gnss.denied=[[60, 145]]", "expect={}"]
    metrics = run(Scenario.load("denied_optical_flow", changes)).metrics
    assert 0.3 < metrics["ins.outage_bound_at_60s_m"] < 3.0
    assert metrics["blind.outage_bound_at_60s_m"] > 2 * metrics["ins.outage_bound_at_60s_m"]
