"""The base of every scenario section: unknown keys, wrong types and non-finite numbers are errors."""

from __future__ import annotations

import re
from typing import Annotated, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

LONGEST_RUN_S = 48 * 3600.0  # longer than any aircraft of this class flies; a slip of the keyboard beyond that
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
Heading: TypeAlias = Annotated[float, Field(ge=-360, le=360)]


class Section(BaseModel):
    """One table of a scenario file. Sensors and legs declare their own keys beside their code, as a Section."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
