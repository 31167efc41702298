"""What must be known of an aircraft to plan for it, to judge its flight and to tell filters: ``envelope.toml``.

An aircraft is a folder: JSBSim's ``<folder>.xml`` and ``envelope.toml``. Shipped ones go by their name, any other by
its path. What JSBSim flies is the XML; nothing here needs JSBSim.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from pathlib import Path
from typing import Self

from pydantic import Field, ValidationError, model_validator

from nav.earth import SEA_LEVEL_DENSITY, isa_density
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.schema import Section

GRAVITY = 9.81  # [m/s^2], for banks and load factors only
LEAST_CLIMB = 0.2  # what is left to climb with at any speed that is flown [m/s]


class Airspeed(Section):
    """Equivalent airspeeds: stall at 1 g, full tank; the slowest flown is ``margin`` times that; and the fastest."""

    stall_mps: float = Field(gt=0, le=100)
    margin: float = Field(gt=1, le=2)
    max_mps: float = Field(gt=0, le=100)


class Bank(Section):
    """The steepest bank that guidance commands."""

    max_deg: float = Field(ge=10, le=70)


class AltitudeRange(Section):
    """Over the ellipsoid, which is the ground."""

    floor_m: float = Field(ge=0, le=10_000)
    ceiling_m: float = Field(gt=0, le=10_000)


class ClimbFit(Section):
    """Steepest steady climb that leaves a tenth of the throttle for tracking, a fit on the safe side.

    The least of three: ``max_mps``; the equivalent airspeed less ``none_below_mps``, the airspeed protection near the
    stall; ``rate_mps`` at sea level and the airspeed ``at_mps``, less with airspeed and altitude: the engine.
    """

    max_mps: float = Field(gt=0, le=50)
    none_below_mps: float = Field(gt=0, le=100)
    rate_mps: float = Field(gt=0, le=50)
    at_mps: float = Field(gt=0, le=100)
    less_per_mps: float = Field(ge=0, le=10)
    less_per_m: float = Field(ge=0, le=0.1)


class DescentFit(Section):
    """Steepest steady descent at idle that leaves the airspeed less than 1 m/s high, in equivalent speeds; a fit."""

    max_mps: float = Field(gt=0, le=50)
    rate_mps: float = Field(ge=0, le=50)
    at_mps: float = Field(gt=0, le=100)
    more_per_mps: float = Field(ge=0, le=10)


class Usual(Section):
    """How it usually flies, which is all that a filter is told: how far scale errors, gusts and wiring count.

    ``load_change_g`` is the change of load factor from one manoeuvre to the next, ``current_change_a`` that of the
    current with the throttle, 1 sigma.
    """

    airspeed_mps: float = Field(gt=0, le=100)
    turn_rate_radps: float = Field(gt=0, le=6)
    load_change_g: float = Field(gt=0, le=10)
    current_a: float = Field(ge=0, le=1000)
    current_change_a: float = Field(default=0.0, ge=0, le=1000)


UNKNOWN_BODY = Usual(airspeed_mps=25.0, turn_rate_radps=0.06, load_change_g=0.1, current_a=2.0)  # a small vehicle


class Current(Section):
    """Electrical load: avionics and payload; a servo at rest, and beyond that at full rate.

    What an electric engine takes on top is JSBSim's to say.
    """

    payload_a: float = Field(ge=0, le=1000)
    servo_idle_a: float = Field(ge=0, le=100)
    servo_running_a: float = Field(ge=0, le=100)


class Launch(Section):
    """The launcher that it takes off from: how high over ground it rests there, and how it is let go.

    It lies nose up by ``pitch_deg``, and is pushed straight along its nose, over ``length_m``, to the true ground speed
    ``speed_mps``.
    """

    height_m: float = Field(gt=1, le=20)
    pitch_deg: float = Field(ge=0, le=45)
    length_m: float = Field(gt=0, le=100)
    speed_mps: float = Field(gt=0, le=100)


class Envelope(Section):
    """What one aircraft can do. SI and radians at every method; airspeeds given to them are true ones."""

    title: str = Field(min_length=1)
    airspeed: Airspeed
    bank: Bank
    altitude: AltitudeRange
    climb: ClimbFit
    descent: DescentFit
    usual: Usual
    current: Current
    launch: Launch | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        slowest = self.airspeed.margin * self.airspeed.stall_mps
        stall = self.airspeed.stall_mps
        if self.launch is not None and self.launch.speed_mps < stall:
            raise ValueError(f"launch.speed_mps: must be flown, from airspeed.stall_mps, {stall:g}")
        if self.airspeed.max_mps <= slowest:
            raise ValueError(f"airspeed.max_mps: must be above margin times stall_mps, {slowest:.1f}")
        if self.altitude.ceiling_m <= self.altitude.floor_m:
            raise ValueError(f"altitude.ceiling_m: must be above floor_m, {self.altitude.floor_m:g}")
        if not self.airspeed.stall_mps <= self.climb.none_below_mps < self.airspeed.max_mps:
            raise ValueError("climb.none_below_mps: must lie between airspeed.stall_mps and airspeed.max_mps")
        speed = self.usual.airspeed_mps
        if not slowest <= speed <= self.airspeed.max_mps:
            least, most = f"{slowest:.1f}", f"{self.airspeed.max_mps:g}"
            raise ValueError(f"usual.airspeed_mps: must be flown, from {least} to {most}")
        if self.climb_limit(speed, self.altitude.floor_m) < LEAST_CLIMB:
            raise ValueError(f"climb.rate_mps: leaves no climb at usual.airspeed_mps, {speed:g}")
        most_turn = GRAVITY * math.tan(self.bank_limit(speed, 0.0)) / speed
        if self.usual.turn_rate_radps > most_turn:
            raise ValueError(f"usual.turn_rate_radps: at most {most_turn:.2f} can be turned at usual.airspeed_mps")
        return self

    @property
    def max_bank(self) -> float:
        """The steepest bank that guidance commands [rad]."""
        return math.radians(self.bank.max_deg)

    def min_airspeed(self, alt_m: float, bank: float = 0.0) -> float:
        """Slowest true airspeed [m/s] flown at an altitude and a bank [rad]: the stall speed with its margin."""
        slowest = self.airspeed.margin * self.airspeed.stall_mps
        return slowest * math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m) / math.cos(bank))

    def max_airspeed(self, alt_m: float) -> float:
        """Fastest true airspeed [m/s] flown at an altitude."""
        return self.airspeed.max_mps * math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m))

    def bank_limit(self, airspeed: float, alt_m: float) -> float:
        """Steepest bank [rad] that keeps the stall margin in a level turn at a true airspeed."""
        load = (airspeed / self.min_airspeed(alt_m)) ** 2
        return min(self.max_bank, math.acos(1.0 / load)) if load > 1.0 else 0.0

    def climb_limit(self, airspeed: float, alt_m: float) -> float:
        """Steepest steady climb [m/s] at a true airspeed: `ClimbFit`."""
        fit = self.climb
        eas = airspeed * math.sqrt(isa_density(alt_m) / SEA_LEVEL_DENSITY)
        by_engine = fit.rate_mps - fit.less_per_m * alt_m - fit.less_per_mps * (eas - fit.at_mps)
        return min(fit.max_mps, eas - fit.none_below_mps, by_engine)

    def descent_limit(self, airspeed: float, alt_m: float) -> float:
        """Steepest steady descent [m/s] at a true airspeed: `DescentFit`."""
        fit = self.descent
        to_tas = math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m))
        return min(fit.max_mps, to_tas * (fit.rate_mps + fit.more_per_mps * (airspeed / to_tas - fit.at_mps)))


def shipped() -> dict[str, Path]:
    """The folders of the shipped aircraft by name."""
    return {file.parent.name: file.parent for file in sorted(data_dir("aircraft").glob("*/envelope.toml"))}


def find(name_or_path: str, beside: Path | None = None) -> Path | None:
    """The folder of a shipped aircraft, or of one by its path, seen from ``beside`` or else from here; None if none."""
    known = shipped()
    if name_or_path in known:
        return known[name_or_path]
    for place in ([beside] if beside is not None else []) + [Path()]:
        folder = (place / name_or_path).resolve()
        if folder.is_dir():
            return folder
    return None


def folder(name_or_path: str) -> Path:
    """The folder of an aircraft. Raises UserError when there is none."""
    found = find(name_or_path)
    if found is None:
        listed = ", ".join(shipped())
        raise UserError(f"{name_or_path}: there is no such aircraft: give the path of its folder, or one of {listed}")
    return found


def load(name_or_path: str) -> Envelope:
    """The envelope of a shipped aircraft, or of one in a folder.

    Raises UserError when the folder is no aircraft's, with the file and key that is missing, wrong or contradictory.
    """
    home = folder(name_or_path)
    model, file = home / f"{home.name}.xml", home / "envelope.toml"
    for needed, what in ((model, "what JSBSim flies"), (file, "what guidance and filters must know")):
        if not needed.is_file():
            other = next((path.name for path in sorted(home.glob("*.xml")) if needed is model), None)
            todo = f"; rename {other}, as it has the name of its folder" if other else ""
            raise UserError(f"{needed}: is missing: an aircraft's folder has {what} in it{todo}")
    try:
        return Envelope.model_validate(tomllib.loads(file.read_text("utf-8-sig")), strict=True)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"{file}: can't be read: {error}") from None
    except ValidationError as error:
        raise UserError(*(f"{file}: {line}" for line in _mistakes(error))) from None


def digest(name_or_path: str) -> str:
    """Digest of all files of an aircraft. Raises UserError when there is none."""
    home, found = folder(name_or_path), hashlib.sha256()
    for file in sorted(path for path in home.rglob("*") if path.is_file()):
        found.update(file.relative_to(home).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()


def _mistakes(error: ValidationError) -> list[str]:
    """One line each: key, and what is wrong with it."""
    lines = []
    for found in error.errors(include_url=False):
        key = ".".join(map(str, found["loc"]))
        match found["type"]:
            case "missing":
                lines.append(f"{key}: is missing: add it")
            case "extra_forbidden":
                lines.append(f"{key}: unknown key: remove it, or is it misspelt?")
            case "value_error":
                lines.append(str(found["ctx"]["error"]))
            case _:
                lines.append(f"{key}: {found['msg'].replace('Input should be', 'must be')}, not {found['input']!r}")
    return lines
