"""The base of every scenario section: unknown keys, wrong types and non-finite numbers are errors."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """One table of a scenario file. Sensors and legs declare their own keys beside their code, as a Section."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
