"""What sensors that look at the ground measure, for the bound: written without the filters' aids, as its model is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nav.samples import Array
from testbed.motion.sections import Terrain
from testbed.score.accuracy import column
from testbed.score.bound_model import EARTH_RATE, PHI, VEL, Model, constant, gauss_markov, rows
from testbed.sensors import SensorConfig
from testbed.sensors.optical_flow import OpticalFlowConfig
from testbed.sensors.rangefinder import RangefinderConfig

if TYPE_CHECKING:
    import xarray


def add_sight(model: Model, dataset: xarray.DataTree, name: str, config: SensorConfig, terrain: Terrain) -> bool:
    """The samples of one sensor that looks at level ground, and its errors; whether it is one, and the ground level.

    Wrong matches of optical flow are left out: the bound is lower without them.
    """
    if terrain.file is not None:
        return False
    recorded = "sensors" in dataset and name in dataset["sensors"]
    times = np.asarray(column(dataset, f"sensors/{name}/time"), float) if recorded else np.zeros(0)
    if isinstance(config, RangefinderConfig):
        _add_range(model, times, config, terrain)
    elif isinstance(config, OpticalFlowConfig):
        _add_flow(model, times, config, terrain)
    else:
        return False
    return True


def _ground(model: Model, terrain: Terrain) -> slice:
    """The height of the ground over the map, of which there is one."""
    if model.ground is None:
        model.ground = model.add(constant([terrain.map_sigma_m]))
    return model.ground


def _sight(model: Model, part: slice, terrain: Terrain) -> tuple[Array, Array]:
    """Range r (K,) along body z, and its change (K, 9) by errors of the motion: r = height / cos(tilt)."""
    way = model.way
    down = way.C_nb[part][:, 2, 2]
    r = (way.lla[part, 2] - terrain.height_m) / down
    changes = np.zeros((len(r), 9))
    # the estimate of C_nb is (I - [phi x]) C_nb, so that of its last element is less by (phi x z)_down
    north, east = way.C_nb[part][:, 0, 2], way.C_nb[part][:, 1, 2]
    changes[:, 0], changes[:, 1] = r * east / down, -r * north / down
    changes[:, 8] = -1.0 / down
    return r, changes


def _add_range(model: Model, times: Array, config: RangefinderConfig, terrain: Terrain) -> None:
    e, way, ground = config.errors(), model.way, _ground(model, terrain)
    scale = model.add(constant([e.scale]))

    def ranges(H: Array, part: slice) -> float:
        r, changes = _sight(model, part, terrain)
        H[:, 0, :9] = changes
        H[:, 0, ground] = -1.0 / way.C_nb[part][:, 2, 2, None]
        H[:, 0, scale] = r[:, None]
        return e.noise

    model.observe(times, rows(1, 1e-3, ranges))


def _add_flow(model: Model, times: Array, config: OpticalFlowConfig, terrain: Terrain) -> None:
    e, way, ground = config.errors(), model.way, _ground(model, terrain)
    scale = model.add(constant([e.scale]))
    slow = model.add(gauss_markov([e.bias] * 2, e.tau))

    def flow(H: Array, part: slice) -> Array:
        r, changes = _sight(model, part, terrain)
        C, v_n, lat = way.C_nb[part], way.v_n[part], way.lla[part, 0]
        earth_n = EARTH_RATE * np.column_stack([np.cos(lat), np.zeros(len(lat)), -np.sin(lat)])
        total = np.zeros(len(r))
        for row, (sign, axis) in enumerate(((-1.0, 1), (1.0, 0))):
            along = C[:, :, axis]
            image = sign * np.sum(along * v_n, axis=1) / r
            H[:, row, VEL] = sign * along / r[:, None]
            H[:, row, PHI] = sign * np.cross(v_n, along) / r[:, None] - np.cross(earth_n, C[:, :, row])
            H[:, row, :9] -= (image / r)[:, None] * changes
            H[:, row, ground] = (image / r / C[:, 2, 2])[:, None]
            H[:, row, scale] = (image + way.omega_b[part, row])[:, None]
            total += (image + way.omega_b[part, row]) ** 2
        H[:, :, slow] = np.eye(2)
        quality = (1 - (r / config.max_range_m) ** 2) * (1 - total / config.max_rate_radps**2)
        return (e.noise / np.sqrt(np.maximum(quality, 1e-3)))[:, None]

    model.observe(times, rows(2, 1e-6, flow))
