"""A named entry of a registry as settings hold it: its name, and the settings of its own that were given.

Reading settings looks nothing up, because that may load torch: `registry` checks names and options before a run starts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator
from pydantic_core import PydanticCustomError


class Choice(BaseModel):
    """`variant = "ism"`, or with settings of its own `variant = {kind = "ism", interval = 0.1}`."""

    model_config = ConfigDict(frozen=True, extra="allow", protected_namespaces=())

    kind: str

    @classmethod
    def of(cls, kind: str, options: Mapping[str, Any] | None = None) -> Choice:
        """The choice of an entry by its name, with options."""
        return cls.model_validate({**(options or {}), "kind": kind})

    @model_validator(mode="before")
    @classmethod
    def _named(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"kind": data}
        if isinstance(data, Mapping) and not isinstance(data.get("kind"), str):
            raise PydanticCustomError("choice", "the options have no name to go with; add the key kind")
        return data

    @model_serializer
    def _plain(self) -> str | dict[str, Any]:
        return {"kind": self.kind, **self.options} if self.options else self.kind

    @property
    def options(self) -> dict[str, Any]:
        """The entry's own settings, as far as they were given."""
        return dict(self.model_extra or {})

    def completed_by(self, other: Choice) -> Choice:
        """`other` where it only adds options to this one, else this one."""
        same = self.kind == other.kind
        return other if same and all(other.options.get(key) == value for key, value in self.options.items()) else self


class Weighted(BaseModel):
    """A loss of another module, by its weight and its own settings: `thin = {lambda = 0.1, depth = 2}`."""

    model_config = ConfigDict(frozen=True, extra="allow", protected_namespaces=())

    weight: Annotated[float, Field(ge=0, allow_inf_nan=False, alias="lambda")]

    @model_serializer
    def _plain(self) -> dict[str, Any]:
        return {"lambda": self.weight, **(self.model_extra or {})}

    def choice(self, name: str) -> Choice:
        """The entry `name` with the options that were given."""
        return Choice.of(name, self.model_extra)

    def with_options(self, options: Mapping[str, Any]) -> Weighted:
        """The same weight, other options."""
        return Weighted.model_validate({**options, "lambda": self.weight})
