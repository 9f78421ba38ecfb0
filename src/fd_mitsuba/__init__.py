"""Text-driven, part-wise 3D editing on Mitsuba 3: a new part grows where the scene says, the base stays as it is."""

from __future__ import annotations

import sys
from typing import Any

__version__ = "0.1.0"


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
