"""What all sections of the settings have in common: frozen, strict, and whole numbers that meet their bounds."""

from __future__ import annotations

import math
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    @model_validator(mode="before")
    @classmethod
    def _large_counts_meet_their_bound(cls, data: Any) -> Any:
        """Pydantic takes 1e300 for no whole number at all, and would not say which are possible."""
        if not isinstance(data, dict):
            return data
        counts = {name for name, field in cls.model_fields.items() if field.annotation is int}
        return {name: _whole(value) if name in counts else value for name, value in data.items()}


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and math.isfinite(value) and value.is_integer() else value
