"""Text-driven, part-wise 3D editing on Mitsuba 3: a new part grows where the scene says, the base stays as it is."""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"


def register() -> Any:
    """The module `mitsuba` with the plugins `focal_region` and `dual_path`, so that `load_file` reads a scene to edit.

    A variant that was set before stays; without one, `llvm_ad_rgb` is set. Call it again after a change of variant.
    """
    from fd_mitsuba.scene.scene_file import ready_mitsuba  # not at the top: importing the package must stay cheap

    return ready_mitsuba()
