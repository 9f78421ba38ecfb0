"""What settings and scenes can name: all registries in one place, and the check of settings before a run starts."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Sequence
from typing import Any

from fd_mitsuba.config import RunConfig, Section
from fd_mitsuba.config.choice import Weighted
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.formats import EXPORTERS
from fd_mitsuba.guidance.sources import GUIDANCES
from fd_mitsuba.guidance.variants import VARIANTS
from fd_mitsuba.scene.region_shapes import REGION_SHAPES
from fd_mitsuba.training import appearance_losses, geometry_losses
from fd_mitsuba.training.appearance_losses import APPEARANCE_LOSSES
from fd_mitsuba.training.geometry_losses import GEOMETRY_LOSSES

REGISTRIES: tuple[Registry[Any], ...] = (
    GUIDANCES,
    VARIANTS,
    GEOMETRY_LOSSES,
    APPEARANCE_LOSSES,
    EXPORTERS,
    REGION_SHAPES,
)


def checked_choices(config: RunConfig) -> RunConfig:
    """The settings with all options of the entries that they name, so that a record of them is complete.

    Raises:
        UserError: an unknown name or a wrong option; names the key.
    """
    guidance = {name: registry.completed(getattr(config.guidance, name), f"guidance.{name}") for name, registry in _ONE}
    changed: dict[str, Section] = {"guidance": config.guidance.model_copy(update=guidance)}
    for name, registry, built_in in (
        ("geometry", GEOMETRY_LOSSES, geometry_losses.built_in_losses(config.geometry)),
        ("appearance", APPEARANCE_LOSSES, appearance_losses.built_in_losses(config.appearance)),
    ):
        section = getattr(config, name)
        losses = _completed_losses(section.losses, registry, built_in, name)
        changed[name] = section.model_copy(update={"losses": losses})
    return config.model_copy(update=changed)


def described(more: Sequence[Registry[Any]] = ()) -> dict[str, dict[str, dict[str, Any]]]:
    """Kind -> name -> `about`, a line, and `settings`, its own with their defaults.

    Args:
        more: registries of packages that are built on this one.

    Raises:
        UserError: the package of an entry point cannot be loaded.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for registry in (*REGISTRIES, *more):
        entries = (registry.entry(name, registry.label) for name in registry.names())
        found[registry.kind] = {
            entry.name: {
                "about": (inspect.getdoc(entry.make) or "").partition("\n")[0],
                "settings": entry.settings().model_dump(mode="json"),
            }
            for entry in entries
        }
    return found


_ONE: tuple[tuple[str, Registry[Any]], ...] = (("kind", GUIDANCES), ("variant", VARIANTS))


def _completed_losses(
    losses: dict[str, Weighted], registry: Registry[Any], built_in: Collection[str], section: str
) -> dict[str, Weighted]:
    completed = {}
    for name, loss in losses.items():
        key = f"{section}.losses.{name}"
        if name in built_in or name == "sds":
            raise UserError(f"{key}: is built in; its weight and settings are keys of the section {section} itself")
        completed[name] = loss.with_options(registry.completed(loss.choice(name), key).options)
    return completed
