"""Levels of detail of an export: face budgets, from the finest on, and how far each is from the full surface."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.final_surface.final_part import FinalPart
from fd_mitsuba.export.solid.solid import LEAST_FACES, Solid
from fd_mitsuba.export.solid.surface_points import surface_points
from fd_mitsuba.scene.mesh_distance import MeshDistance

_MOST_LEVELS = 8
_POINTS = 20_000
_VOLUME_CHANGE_SAID = 0.05


def read_levels(texts: Iterable[str]) -> list[int]:
    """The face budgets in `--faces 20000,5000 1000`, the largest first.

    Raises:
        UserError: not whole numbers, too small ones, one twice, or too many of them.
    """
    words = [word for text in texts for word in text.split(",")]
    for word in words:
        if not re.fullmatch(r"[0-9]{1,9}", word):
            raise UserError(f"--faces {word}: is no number of triangles; give numbers such as 20000,5000,1000")
    return checked_levels([int(word) for word in words])


def checked_levels(faces: int | Sequence[int] | None) -> list[int]:
    """Face budgets, the largest first; none where there is no budget.

    Raises:
        UserError: too small ones, one twice, or too many.
    """
    levels = [] if faces is None else [faces] if isinstance(faces, int) else list(faces)
    for level in levels:
        if level < LEAST_FACES:
            raise UserError(f"--faces {level}: give {LEAST_FACES} or more")
        if levels.count(level) > 1:
            raise UserError(f"--faces {level}: is named twice; name each level once")
    if len(levels) > _MOST_LEVELS:
        raise UserError(f"--faces: {len(levels)} levels; give at most {_MOST_LEVELS}")
    return sorted(levels, reverse=True)


def level_folder(export: Path, faces: int) -> Path:
    """Where a level after the first goes."""
    return export / f"lod_{faces}"


def remove_other_levels(export: Path, levels: Collection[int]) -> None:
    """Take away the folders of levels that an earlier export wrote and this one has not, so that nothing old lies
    beside what is new."""
    for folder in export.glob("lod_*"):
        number = folder.name.removeprefix("lod_")
        if folder.is_dir() and not folder.is_symlink() and number.isdecimal() and int(number) not in levels:
            shutil.rmtree(folder)


def within_budget(name: str, part: FinalPart, faces: int, say: Callable[[str], None], unit: float = 1.0) -> FinalPart:
    """The part with at most `faces` faces; `say` hears what became of it, in one line.

    Args:
        unit: what a unit of the part's frame is in that of the scene.
    """
    small = part.decimated(faces)
    count, size = len(small.solid.faces), float(np.ptp(part.solid.vertices, axis=0).max())
    if count <= faces and small is part:
        say(f"--faces {faces}: part {name!r} has its full surface, {count} faces")
        return part
    away, volume = largest_deviation(part.solid, small.solid), part.solid.volume
    has = "has" if count <= faces else "keeps"
    line = f"--faces {faces}: part {name!r} {has} {count} faces, {away * unit:.3g} off the full surface at most"
    line += f", {away / size:.2%} of its size"
    kept = small.solid.volume / volume if volume > 0 else 1.0
    if count > faces:
        line += "; with fewer it would fall apart"
    elif abs(kept - 1) > _VOLUME_CHANGE_SAID:
        line += f"; it has {kept:.0%} of its volume left: allow more faces for a truer shape"
    say(line)
    return small


def largest_deviation(one: Solid, other: Solid, seed: int = 0) -> float:
    """The largest distance from the surface of either solid to the other's, at their vertices and 20,000 points each.

    Of a surface that is farther away only between these points it says too little: by less than their distance, a
    hundredth of the solid's size at about.
    """
    pairs = []
    for own, others in ((one, other), (other, one)):
        points = surface_points(own.vertices, own.faces, _POINTS, seed)[0]
        pairs.append((np.concatenate([own.vertices, points]), MeshDistance(others.vertices, others.faces)))
    return float(max(mesh.unsigned(points).max() for points, mesh in pairs))
