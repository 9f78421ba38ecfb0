"""Which settings belong to a run's identity: all but those that are marked with `MAY_CHANGE` where they are declared.

A setting is marked if the run that goes on with another value of it makes the same result: how often something is
written, pictures for people, how the work is cut up or where it is done. Other cores or other portions round
differently, so the bytes may differ where they do; only the same settings with one thread promise the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel


class _MayChange:
    """The type of `MAY_CHANGE`."""

    def __repr__(self) -> str:
        return "MAY_CHANGE"


MAY_CHANGE = _MayChange()
"""Beside a field's bounds in its `Annotated`: `--resume` takes another value of it."""


def changeable_settings(model: type[BaseModel]) -> frozenset[str]:
    """The settings of a model that are marked with `MAY_CHANGE`, as `section.key`."""
    return frozenset(_marked(model, ""))


def identity_settings(config: BaseModel, without: frozenset[str] = frozenset()) -> dict[str, Any]:
    """`section.key` -> value as in JSON, of all settings that are part of the identity.

    Args:
        without: sections that do not count.
    """
    left_out = changeable_settings(type(config))
    return {
        key: value
        for key, value in flat_settings(config.model_dump(mode="json")).items()
        if key not in left_out and key.partition(".")[0] not in without
    }


def flat_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Nested settings as `section.key` -> value."""
    return dict(_flat(settings, ""))


def _marked(model: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _marked(field.annotation, f"{prefix}{name}.")
        elif MAY_CHANGE in field.metadata:
            yield f"{prefix}{name}"


def _flat(settings: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
