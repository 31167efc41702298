"""The base of every scenario section: unknown keys, wrong types and non-finite numbers are errors."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

Heading: TypeAlias = Annotated[float, Field(ge=-360, le=360)]


class Section(BaseModel):
    """One table of a scenario file. Sensors and legs declare their own keys beside their code, as a Section."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
