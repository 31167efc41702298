"""The base of every scenario section: unknown keys, wrong types and non-finite numbers are errors."""

from __future__ import annotations

import re
from typing import Annotated, TypeAlias

from pydantic import AliasChoices, AliasPath, BaseModel, ConfigDict, Field

LONGEST_RUN_S = 48 * 3600.0  # longer than any aircraft of this class flies; a slip of the keyboard beyond that
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
Heading: TypeAlias = Annotated[float, Field(ge=-360, le=360)]


class Section(BaseModel):
    """One table of a scenario file. Sensors and legs declare their own keys beside their code, as a Section."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def keys_of(model: type[BaseModel]) -> dict[str, str]:
    """What a file may call the fields of a model, by which names they have there: those of the user's have aliases."""
    named = model.model_config.get("populate_by_name") or model.model_config.get("validate_by_name")
    keys: dict[str, str] = {}
    for name, field in model.model_fields.items():
        alias = field.validation_alias
        choices = alias.choices if isinstance(alias, AliasChoices) else [alias] if alias is not None else []
        aliases = [str(one.path[0]) if isinstance(one, AliasPath) else one for one in choices]
        keys |= dict.fromkeys([*aliases, *([name] if named or not aliases else [])], name)
    return keys
