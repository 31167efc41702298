"""A MAVSDK ground station: connects, asks everything, fails the GNSS and heals it, prints as JSON what it was told.

Run by the Python of the clients' environment: ``mavsdk_station.py URL BEFORE_S OFF_S OK_S``.
"""

from __future__ import annotations

import asyncio
import enum
import json
import sys
import time
from collections.abc import AsyncIterator, Awaitable
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.failure import FailureAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.failure import FailureType, FailureUnit

STREAMS = (
    "position", "home", "in_air", "armed", "flight_mode", "attitude_euler", "attitude_quaternion", "velocity_ned",
    "gps_info", "raw_gps", "health", "health_all_ok", "status_text", "odometry", "ground_truth", "fixedwing_metrics",
    "imu", "scaled_pressure", "heading", "altitude", "wind", "unix_epoch_time", "position_velocity_ned",
)  # fmt: skip
CONNECT_S = 60.0
ANSWER_S = 15.0


def plain(value: Any) -> Any:
    """``value`` as JSON has it."""
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if hasattr(value, "__dict__"):
        return {key: plain(one) for key, one in vars(value).items() if not key.startswith("_")}
    return value


async def session(url: str, before_s: float, off_s: float, ok_s: float) -> dict[str, Any]:
    """Everything heard, by stream as [time, value], and everything asked, as time it took and answer."""
    heard: dict[str, list[Any]] = {name: [] for name in STREAMS}
    asked: dict[str, Any] = {}
    began = time.monotonic()

    async def listen(name: str, stream: AsyncIterator[Any]) -> None:
        async for value in stream:
            heard[name].append([time.monotonic() - began, plain(value)])

    async def ask(name: str, answer: Awaitable[Any]) -> None:
        start = time.monotonic()
        try:
            told = {"answer": plain(await asyncio.wait_for(answer, ANSWER_S))}
        except Exception as error:
            told = {"error": f"{type(error).__name__}: {error}"}
        asked[name] = {"at": start - began, "took": time.monotonic() - start, **told}

    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        vehicle = await mavsdk.first_autopilot(timeout_s=CONNECT_S)
        if vehicle is None:
            return {"error": f"no autopilot at {url}"}
        telemetry = TelemetryAsync(vehicle)
        listeners = [asyncio.create_task(listen(name, getattr(telemetry, f"subscribe_{name}")())) for name in STREAMS]
        asked["system"] = {"answer": [plain(await vehicle.autopilot_type()), plain(await vehicle.vehicle_type())]}
        info, params, mission = InfoAsync(vehicle), ParamAsync(vehicle), MissionAsync(vehicle)
        await ask("version", info.get_version())
        await ask("identification", info.get_identification())
        await ask("product", info.get_product())
        await ask("params", params.get_all_params())
        await ask("mission_raw", MissionRawAsync(vehicle).download_mission())
        await ask("mission", mission.download_mission())
        await ask("rate", telemetry.set_rate_attitude_euler(10.0))
        mission_progress = listen("mission_progress", mission.subscribe_mission_progress())
        heard["mission_progress"] = []
        listeners.append(asyncio.create_task(mission_progress))
        limit = time.monotonic() + CONNECT_S
        while not (heard["health_all_ok"] and heard["health_all_ok"][-1][1]) and time.monotonic() < limit:
            await asyncio.sleep(0.1)
        await asyncio.sleep(before_s)
        failure = FailureAsync(vehicle)
        await ask("off", failure.inject(FailureUnit.SENSOR_GPS, FailureType.OFF, 0))
        await asyncio.sleep(off_s)
        await ask("ok", failure.inject(FailureUnit.SENSOR_GPS, FailureType.OK, 0))
        await asyncio.sleep(ok_s)
        await ask("battery", failure.inject(FailureUnit.SYSTEM_BATTERY, FailureType.OFF, 0))
        for listener in listeners:
            listener.cancel()
        await asyncio.gather(*listeners, return_exceptions=True)
    return {"asked": asked, "heard": heard}


if __name__ == "__main__":
    print(json.dumps(asyncio.run(session(sys.argv[1], *map(float, sys.argv[2:])))))
