"""Truth for sensor tests: a body that turns, climbs and shakes, not a flight but lively in every column."""

import numpy as np
from scipy.spatial.transform import Rotation

from testbed.motion.table import TruthBlock

RATE_HZ = 200.0


def lively(ticks: int, rate_hz: float = RATE_HZ) -> TruthBlock:
    block = TruthBlock.empty(0, ticks)
    t = np.arange(ticks) / rate_hz
    block.t[:] = t
    block.lat[:] = 0.6 + 4e-6 * t
    block.lon[:] = 1.9 + 3e-6 * t
    block.h[:] = 800 + 2 * t
    block.v_n[:] = np.stack([25 * np.cos(0.1 * t), 25 * np.sin(0.1 * t), -2 + 0 * t], axis=1)
    angles = np.stack([0.1 * t, 0.1 * np.sin(t), 0.3 * np.sin(0.7 * t)], axis=1)
    block.q_nb[:] = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    block.omega_b[:] = np.stack([0.2 * np.cos(0.7 * t), 0.1 * np.cos(t), 0.1 + 0 * t], axis=1)
    block.dtheta[1:] = block.omega_b[1:] / rate_hz
    block.dv[1:] = np.stack([np.sin(t), 0.5 * np.cos(t), -9.8 + 0 * t], axis=1)[1:] / rate_hz
    block.airspeed[:] = 25 + np.sin(t)
    block.alpha[:] = 0.05 * np.cos(t)
    block.beta[:] = 0.02 * np.sin(t)
    block.pressure[:] = 92_000 - 24 * t
    block.temperature[:] = 283 - 0.01 * t
    block.density[:] = 1.13 - 1e-4 * t
    block.engine_rpm[:] = 4500 + 200 * np.sin(0.5 * t)
    block.current[:] = 2 + np.sin(3 * t)
    return block


def still(ticks: int, rate_hz: float = RATE_HZ) -> TruthBlock:
    """At rest, level, heading north, without gravity or Earth rate: what a sensor then shows is its error."""
    block = TruthBlock.empty(0, ticks)
    block.t[:] = np.arange(ticks) / rate_hz
    block.q_nb[:, 0] = 1.0
    block.temperature[:] = 288.15
    block.pressure[:] = 101_325.0
    block.density[:] = 1.225
    return block


def cut(block: TruthBlock, cuts: list[int]) -> list[TruthBlock]:
    """The same rows in several blocks; equal cuts give empty blocks."""
    ends = sorted(cuts)
    return [block.rows(a, b) for a, b in zip([0, *ends], [*ends, len(block)], strict=True)]
