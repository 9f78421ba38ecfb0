"""All methods that this package has, registered: import `BASELINES` from here."""

from __future__ import annotations

from fd_mitsuba.baselines import dreameditor, editors_2d, fantasia3d, focaldreamer, in2n, voxe
from fd_mitsuba.baselines.interface import BASELINES

__all__ = ["BASELINES", "dreameditor", "editors_2d", "fantasia3d", "focaldreamer", "in2n", "voxe"]
