"""Text-driven, part-wise 3D editing on Mitsuba 3: a new part grows where the scene says, the base stays as it is."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fd_mitsuba.api import Run, demo_scene, edit, evaluate, import_asset, load_scene
    from fd_mitsuba.config import RunConfig as Config
    from fd_mitsuba.config import Section
    from fd_mitsuba.config.choice import Choice
    from fd_mitsuba.errors import Interrupted, RunStopped, UserError
    from fd_mitsuba.export.formats import EXPORTERS, Exporter
    from fd_mitsuba.guidance.interface import GuidanceResult
    from fd_mitsuba.guidance.query import Variant
    from fd_mitsuba.guidance.sources import GUIDANCES
    from fd_mitsuba.guidance.variants import VARIANTS
    from fd_mitsuba.scene.region_shapes import REGION_SHAPES
    from fd_mitsuba.training.appearance_losses import APPEARANCE_LOSSES, AppearanceLoss
    from fd_mitsuba.training.geometry_losses import GEOMETRY_LOSSES, FieldLoss

__version__ = "0.1.0"
__all__ = [
    "APPEARANCE_LOSSES",
    "AppearanceLoss",
    "Choice",
    "Config",
    "EXPORTERS",
    "Exporter",
    "FieldLoss",
    "GEOMETRY_LOSSES",
    "GUIDANCES",
    "GuidanceResult",
    "Interrupted",
    "REGION_SHAPES",
    "Run",
    "RunStopped",
    "Section",
    "UserError",
    "VARIANTS",
    "Variant",
    "__version__",
    "demo_scene",
    "edit",
    "evaluate",
    "import_asset",
    "load_scene",
    "register",
]
_PLACES = {
    "APPEARANCE_LOSSES": ("fd_mitsuba.training.appearance_losses", "APPEARANCE_LOSSES"),
    "AppearanceLoss": ("fd_mitsuba.training.appearance_losses", "AppearanceLoss"),
    "Choice": ("fd_mitsuba.config.choice", "Choice"),
    "Config": ("fd_mitsuba.config", "RunConfig"),
    "EXPORTERS": ("fd_mitsuba.export.formats", "EXPORTERS"),
    "Exporter": ("fd_mitsuba.export.formats", "Exporter"),
    "FieldLoss": ("fd_mitsuba.training.geometry_losses", "FieldLoss"),
    "GEOMETRY_LOSSES": ("fd_mitsuba.training.geometry_losses", "GEOMETRY_LOSSES"),
    "GUIDANCES": ("fd_mitsuba.guidance.sources", "GUIDANCES"),
    "GuidanceResult": ("fd_mitsuba.guidance.interface", "GuidanceResult"),
    "Interrupted": ("fd_mitsuba.errors", "Interrupted"),
    "REGION_SHAPES": ("fd_mitsuba.scene.region_shapes", "REGION_SHAPES"),
    "Run": ("fd_mitsuba.runs.run", "Run"),
    "RunStopped": ("fd_mitsuba.errors", "RunStopped"),
    "Section": ("fd_mitsuba.config", "Section"),
    "UserError": ("fd_mitsuba.errors", "UserError"),
    "VARIANTS": ("fd_mitsuba.guidance.variants", "VARIANTS"),
    "Variant": ("fd_mitsuba.guidance.query", "Variant"),
    "demo_scene": ("fd_mitsuba.api", "demo_scene"),
    "edit": ("fd_mitsuba.api", "edit"),
    "evaluate": ("fd_mitsuba.api", "evaluate"),
    "import_asset": ("fd_mitsuba.api", "import_asset"),
    "load_scene": ("fd_mitsuba.api", "load_scene"),
}
"""Where the public names live. They are imported when they are first used, so that the package imports in no time."""


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def register() -> Any:
    """The module `mitsuba` with the plugins `focal_region` and `dual_path`, so that `load_file` reads a scene to edit.

    A variant that was set before stays; without one, `llvm_ad_rgb` is set. Needed only where `mitsuba` was imported
    after this package; call it again after a change of variant then.
    """
    from fd_mitsuba.scene.scene_file import ready_mitsuba  # not at the top: importing the package must stay cheap

    return ready_mitsuba()


def _register_with_loaded_mitsuba() -> None:
    """Where `mitsuba` is imported already, its present variant and every later one get the plugins by themselves.

    Otherwise nothing happens: importing Mitsuba from here would settle which LLVM it takes, and cost half a second.
    """
    mi = sys.modules.get("mitsuba")
    if mi is None:
        return
    from fd_mitsuba.scene import plugins

    mi.detail.add_variant_callback(lambda before, after: plugins.register(mi))
    if mi.variant() is not None:
        plugins.register(mi)


_register_with_loaded_mitsuba()
