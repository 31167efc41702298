"""Datasheet units in SI: multiply to come in, divide to go out. The only place where sensors convert."""

from __future__ import annotations

import math
from typing import Annotated, TypeAlias

from pydantic import Field

from nav.earth import STANDARD_GRAVITY

DEG = math.pi / 180  # rad
ARCSEC = DEG / 3600  # rad
DEG_PER_H = DEG / 3600  # rad/s
DEG_PER_ROOT_H = DEG / 60  # rad/sqrt(s), angle random walk
DEG_PER_H_PER_ROOT_H = DEG_PER_H / 60  # rad/s/sqrt(s), rate random walk
G = STANDARD_GRAVITY  # m/s^2
MG = 1e-3 * G  # m/s^2
MPS_PER_ROOT_H = 1 / 60  # m/s/sqrt(s), velocity random walk
MG_PER_ROOT_H = MG / 60  # m/s^2/sqrt(s), acceleration random walk
PPM = 1e-6
PERCENT = 1e-2
MRAD = 1e-3  # rad
MICROTESLA = 1e-6  # T

# A lever arm in metres, body forward-right-down; a hundred of them is longer than any aircraft, and likely millimetres.
Metres: TypeAlias = Annotated[float, Field(ge=-100, le=100)]
LeverArm: TypeAlias = tuple[Metres, Metres, Metres]
