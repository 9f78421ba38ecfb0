"""A body: a mesh in the canonical frame with the anchors where parts grow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE
from fd_mitsuba.prior.data.primitives import Solid, join

_BESIDE = np.array([1.3e-5, 0.7e-5, 0.4e-5])
_POINTS = ("head_top", "forehead", "back", "side")


@dataclass(frozen=True)
class Body:
    """A base mesh in the canonical frame and where parts attach to it.

    Attributes:
        solid: the mesh, bounding box centred, longest side `BASE_LONGEST_SIDE`.
        head_top: the highest point of the head; `head_radius` is the head's half-width there.
        forehead: where a horn starts, `horn_direction` its unit direction.
        back: middle of the shoulders or upper back; `back_half_width` from there to the flank, `reach` a length
            that wings are measured by.
        side: a point on the +x flank; `side_height` the flank's usable height.
        bottom: y of the feet with the footprint's half lengths `foot_x`, `foot_z` about (0, bottom, `foot_centre_z`).
        upright: whether the back is the rear side (a person) and not the upper side (a horse).
    """

    solid: Solid
    head_top: np.ndarray
    head_radius: float
    forehead: np.ndarray
    horn_direction: np.ndarray
    back: np.ndarray
    back_half_width: float
    reach: float
    side: np.ndarray
    side_height: float
    bottom: float
    foot_x: float
    foot_z: float
    foot_centre_z: float
    upright: bool = False

    def eyes(self) -> np.ndarray:
        """Surface points (2, 3) seen from the front where the eyes are, the +x one first."""
        across, height = 0.42 * self.head_radius, self.forehead[1] - 0.3 * self.head_radius
        front = np.array([across, height, self.forehead[2]])
        return np.stack([self._towards(front * (sign, 1, 1), (0, 0, -1)) for sign in (1, -1)])

    def rear(self) -> np.ndarray:
        """The surface point (3,) where a tail starts."""
        height = self.side[1] - 0.3 * self.side_height if self.upright else self.side[1] + 0.2 * self.side_height
        return self._towards(np.array([0, height, self.back[2]]), (0, 0, 1))

    def spine(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Surface points (count, 3) along the middle of the back, and their outward directions (count, 3)."""
        share = np.linspace(0, 1, count)
        if self.upright:
            high, low = self.head_top[1] - 0.3 * self.head_radius, self.side[1] - 0.3 * self.side_height
            points = [self._towards(np.array([0, high + t * (low - high), 0]), (0, 0, 1)) for t in share]
            return np.stack(points), np.tile([0.0, 0.35, -0.94], (count, 1))
        first, last = self.back[2], self.rear()[2] * 0.8
        points = [self._towards(np.array([0, 0, first + t * (last - first)]), (0, -1, 0)) for t in share]
        return np.stack(points), np.tile([0.0, 1.0, 0.0], (count, 1))

    def _towards(self, through: np.ndarray, direction: tuple[float, float, float]) -> np.ndarray:
        """The first surface point of the ray that comes from far away and passes `through`; that point if it misses.

        The ray is a little beside it, because bodies have edges in the plane x = 0, and rounding lets a ray slip
        through an edge that it meets exactly.
        """
        ray = np.asarray(direction, float)
        origin = through - ray * (ray @ through + 10) + _BESIDE
        a, b, c = (self.solid.vertices[self.solid.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        slope = normal @ ray
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.einsum("ij,ij->i", normal, a - origin) / slope
            hit = origin + distance[:, None] * ray
            inside = np.all(
                [np.einsum("ij,ij->i", np.cross(q - p, hit - p), normal) >= 0 for p, q in ((a, b), (b, c), (c, a))],
                axis=0,
            )
        inside &= np.abs(slope) > 1e-12
        return hit[inside][np.argmin(distance[inside])] if inside.any() else np.asarray(through, float)


def finish(parts: list[Solid], *, upright: bool = False, **anchors) -> Body:
    """The body of these solids, moved and scaled to the canonical frame together with its anchors."""
    solid = join(parts)
    low, high = solid.vertices.min(0), solid.vertices.max(0)
    centre, scale = (low + high) / 2, BASE_LONGEST_SIDE / (high - low).max()
    placed = {}
    for name, value in anchors.items():
        if name in _POINTS:
            placed[name] = (np.asarray(value, float) - centre) * scale
        elif name == "horn_direction":
            placed[name] = np.asarray(value, float) / np.linalg.norm(value)
        elif name == "bottom":
            placed[name] = (value - centre[1]) * scale
        elif name == "foot_centre_z":
            placed[name] = (value - centre[2]) * scale
        else:
            placed[name] = float(value) * scale
    return Body(Solid((solid.vertices - centre) * scale, solid.faces), upright=upright, **placed)


def jitter(rng: np.random.Generator, value: float, share: float = 0.12) -> float:
    """The value times a factor drawn uniformly from 1 - share to 1 + share."""
    return value * (1 + share * rng.uniform(-1, 1))


def head_size(body: Body) -> float:
    """The half-width that head-worn parts are made for: neither a bead on a bird nor a lid on a mug."""
    return float(np.clip(body.head_radius, 0.15, 0.4))
