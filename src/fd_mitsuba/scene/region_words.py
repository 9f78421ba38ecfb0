"""Places on an object by words: `top`, `head`, `left side`, `front of the head`, or a point; and the region there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.body_outline import animal_eye_level, back_slice, eye_level
from fd_mitsuba.scene.head_top import below_ears
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.picture_rays import pixel_ray
from fd_mitsuba.scene.triangle_rays import TriangleRays

_REACH, _REACH_OF_FACE = 0.3, 1.0
"""Share of a region's half axis by which it reaches into the object, or out of it where it subtracts. What is worn on a
face goes round it."""
_HEAD_WIDTHS = 0.17, 0.44
"""Least and largest width of a head, as shares of the longest side: what is put on a mug is no wider."""
_TOP_WIDTHS = 0.29, 0.44
"""The same of what is on top of an object without a head, such as the lid of a teapot, whose knob is no measure."""
_HOLLOW = 0.5
"""Of the height: what is so far below the top, seen from above, is the floor of a vessel."""
_FEET_APART = 0.4
"""Least length of what an animal on four legs stands on, as a share of its height."""
_SAMPLES = 20_000
_UP, _FRONT, _LEFT = np.eye(3)[1], np.eye(3)[2], np.eye(3)[0]
_DIRECTIONS = {
    "top": _UP, "bottom": -_UP, "front": _FRONT, "rear": -_FRONT, "left side": _LEFT, "right side": -_LEFT,
}  # fmt: skip
_SYNONYMS = {
    "above": "top", "below": "bottom", "underside": "bottom", "left": "left side", "right": "right side",
    "behind": "rear", "back side": "rear", "backside": "rear", "top of the head": "head", "on the head": "head",
    "top of head": "head", "chest": "front",
}  # fmt: skip
POINT = "point"
"""Name of a place that is no word."""
WORDS = ("top", "head", "back", "front", "rear", "left side", "right side", "bottom")
"""What `--at` knows, beside `front of the head` and the like, and points."""


@dataclass(frozen=True)
class Place:
    """A point of a surface.

    Attributes:
        name: for the region there, of letters and `_`.
        point: (3,) on the surface, or between the feet.
        normal: (3,) unit, out of the object.
        about: what was understood, for people.
        reach: share of its half axis by which a region there reaches into the object.
    """

    name: str
    point: np.ndarray
    normal: np.ndarray
    about: str
    reach: float = _REACH


@dataclass(frozen=True)
class PlacedRegion:
    """An ellipsoid: the unit sphere scaled by `half_axes`, turned by `rotation` (3, 3), moved to `centre`.

    With `subtracts` its part is cut out of the base. `part` and `prompt`, where there are any, are the part that it
    belongs to and what that is to be, for a scene of several parts.
    """

    name: str
    centre: np.ndarray
    half_axes: np.ndarray
    rotation: np.ndarray
    subtracts: bool = False
    part: str | None = None
    prompt: str | None = None

    def to_world(self) -> np.ndarray:
        """(4, 4) from the unit sphere."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation * self.half_axes
        matrix[:3, 3] = self.centre
        return matrix


class ObjectPlaces:
    """Finds places on an object that has +y up and looks along +z.

    Args:
        vertices: (V, 3), any unit.
        faces: (F, 3) outward.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices, self.faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        used = self.vertices[np.unique(self.faces)]
        self.low, self.high = used.min(axis=0), used.max(axis=0)

    @property
    def longest_side(self) -> float:
        """Of the bounding box."""
        return float((self.high - self.low).max())

    @cached_property
    def head_width(self) -> float:
        """At the height of its eyes; within what a head can have of the longest side."""
        return self._width(self._eye_level(), _HEAD_WIDTHS)

    @cached_property
    def top_width(self) -> float:
        """As the head's, of what is below its highest point."""
        return self._width(eye_level(self._points, self.find("top").point[1], self._height), _TOP_WIDTHS)

    def _width(self, around: np.ndarray, shares: tuple[float, float]) -> float:
        width = float(np.ptp(np.quantile(around[:, 0], (0.02, 0.98))))
        least, most = (share * self.longest_side for share in shares)
        return min(max(width, least), most)

    @property
    def _height(self) -> float:
        return float(self.high[1] - self.low[1])

    def find(self, text: str) -> Place:
        """The place that the words of `--at` mean, the surface's nearest point to `x,y,z`, or what is seen at a pixel.

        The last is said as "pixel 412 180 of preview.png", of a picture that `fd_mitsuba preview` has made.

        Left and right are the object's own: an animal that looks along +z has its left at +x.

        Raises:
            UserError: words that are not known, a point that is none.
        """
        ray = pixel_ray(text)
        if ray is not None:
            return self._seen(text, *ray)
        if "," in text:
            return self._point(text)
        words = " ".join(text.lower().replace("_", " ").replace("-", " ").split()).removeprefix("the ")
        words = _SYNONYMS.get(words, words)
        of_head = re.fullmatch(r"(.+?) of (?:the )?head", words)
        side = _SYNONYMS.get(of_head[1], of_head[1]) if of_head else words
        if of_head:
            side = {"back": "rear"}.get(side, side)
        if words == "head" or (of_head and side == "top"):
            return self._head
        if of_head and side in _DIRECTIONS:
            return self._beside_head(_DIRECTIONS[side], f"{side}_of_head".replace(" ", "_"), f"the {side} of its head")
        if words == "back":
            if self._walks:
                across = back_slice(self._middle_points(), self._height)
                return self._side(_UP, "back", across, "its back, seen from above")
            return self._side(-_FRONT, "back", self._points, "its back, away from where it looks")
        if words == "bottom":
            return Place("bottom", self._between_feet(), -_UP.astype(np.float64), "its bottom")
        if words == "belly":
            return self._side(-_UP, "belly", self._points, "its belly, seen from below")
        if words in _DIRECTIONS:
            return self._side(_DIRECTIONS[words], words.replace(" ", "_"), self._points, f"its {words}")
        raise UserError(f"--at {text}: is not known; say {', '.join(WORDS)}, 'front of the head', or x,y,z")

    def region(
        self, place: Place, size: float | tuple[float, ...], name: str | None = None, subtracts: bool = False
    ) -> PlacedRegion:
        """The ellipsoid at a place: it reaches a little into the object, or with `subtracts` stands out of it a little.

        Args:
            size: its width, or width, height and depth, in the object's unit: height is along the place's normal.
        """
        half = np.broadcast_to(np.asarray(size, dtype=np.float64), (3,)) / 2
        outwards = (_REACH - 1 if subtracts else 1 - place.reach) * half[1]
        centre = place.point + outwards * place.normal
        return PlacedRegion(name or place.name, centre, half, upright(place.normal), subtracts)

    @cached_property
    def _corners(self) -> np.ndarray:
        return self.vertices[self.faces]

    @cached_property
    def _rays(self) -> TriangleRays:
        return TriangleRays(self._corners)

    @cached_property
    def _points(self) -> np.ndarray:
        """(N, 3) points all over the surface, evenly by area."""
        corners = self._corners
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        random = np.random.default_rng(0)
        chosen = random.choice(len(corners), size=_SAMPLES, p=area / area.sum())
        return np.einsum("ij,ijk->ik", random.dirichlet([1.0, 1.0, 1.0], size=_SAMPLES), corners[chosen])

    @cached_property
    def _walks(self) -> bool:
        """Whether it is longer than it is high, or stands on feet far behind each other, as animals on four legs do."""
        size, feet = self.high - self.low, np.ptp(self._feet, axis=0)
        return bool(size[2] > size[1] or (feet[2] > _FEET_APART * size[1] and feet[2] > 2 * feet[0]))

    @cached_property
    def _head(self) -> Place:
        seen = self._side(_UP, "head", self._head_points(), "the top of its head")
        return replace(seen, point=below_ears(seen.point, self._rays.way_out, self.longest_side, self._height))

    def _head_points(self) -> np.ndarray:
        """The upper end of an upright object; of a long one the upper part of its front."""
        points = self._front_points()
        return points[points[:, 1] >= points[:, 1].max() - 0.25 * self._height]

    def _front_points(self) -> np.ndarray:
        """Of a long object those of its front, of an upright one all."""
        points = self._points
        return points[points[:, 2] >= self.high[2] - 0.3 * np.ptp(points[:, 2])] if self._walks else points

    def _eye_level(self) -> np.ndarray:
        """Points around its head at the height of its eyes."""
        level = animal_eye_level if self._walks else eye_level
        return level(self._front_points(), self._head.point[1], self._height)

    def _beside_head(self, direction: np.ndarray, name: str, about: str) -> Place:
        """Where a ray from that side meets the head, at the height of its eyes or through what is there."""
        around = self._eye_level()
        middle = np.quantile(around, (0.02, 0.98), axis=0).mean(axis=0)
        hit = self._rays.first(middle + direction * (2 * self.longest_side), -direction)
        if hit is None:
            hit = around[np.argmax(around @ direction)]
        reach = _REACH_OF_FACE if direction is _FRONT else _REACH
        return Place(name, hit, direction.astype(np.float64), about, reach)

    @cached_property
    def _feet(self) -> np.ndarray:
        return self._points[self._points[:, 1] <= self.low[1] + 0.15 * self._height]

    def _between_feet(self) -> np.ndarray:
        """The middle of what it stands on."""
        feet = self._feet
        return np.array([feet[:, 0].mean(), self.low[1], feet[:, 2].mean()])

    def _middle_points(self) -> np.ndarray:
        points, size = self._points, self.high - self.low
        middle = (self.low[2] + self.high[2]) / 2
        found = points[np.abs(points[:, 2] - middle) < 0.2 * size[2]]
        return found if len(found) else points

    def _side(self, direction: np.ndarray, name: str, points: np.ndarray, about: str) -> Place:
        """Where a ray from that side meets what is outermost there."""
        along = points @ direction
        reach = max(float(np.ptp(along)), 1e-300)
        middle = (self.low + self.high) / 2
        if name in ("left_side", "right_side"):
            aim = np.array([middle[0], np.median(self._middle_points()[:, 1]), middle[2]])
        elif name in ("front", "rear", "back") and not self._walks:
            aim = np.array([np.median(points[:, 0]), middle[1], middle[2]])
        else:
            aim = points[along >= along.max() - 0.15 * reach].mean(axis=0)
        start = aim + direction * (2 * self.longest_side)
        hit = self._rays.first(start, -direction)
        if hit is not None and direction is _UP and hit[1] < self.high[1] - _HOLLOW * self._height:
            hit = np.array([hit[0], points[:, 1].max(), hit[2]])  # in the middle of a rim, not on the floor below
        if hit is None:
            near = points[along >= along.max() - 0.15 * reach]
            hit = near[np.argmin(np.linalg.norm(near - aim, axis=1))]
        return Place(name, hit, direction.astype(np.float64), about)

    def _point(self, text: str) -> Place:
        try:
            point = np.array([float(value) for value in text.split(",")])
        except ValueError:
            point = np.zeros(0)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise UserError(f"--at {text}: is no point; write x,y,z in the scene's unit, such as 0,1.5,0.2")
        hit = MeshDistance(self.vertices, self.faces).feet(point[None])[0]
        shown = ", ".join(f"{value:.4g}" for value in hit)
        return Place(POINT, hit, self._outward(hit), f"the nearest point of its surface, ({shown})")

    def _seen(self, text: str, origin: np.ndarray, direction: np.ndarray) -> Place:
        hit = self._rays.first(origin, direction)
        if hit is None:
            raise UserError(f"--at {text}: nothing of the object is seen at that pixel; take one of the object itself")
        shown = ", ".join(f"{value:.4g}" for value in hit)
        return Place(POINT, hit, self._outward(hit), f"what is seen at that pixel, ({shown})")

    def _outward(self, point: np.ndarray) -> np.ndarray:
        """The mean normal of the surface within a twentieth of the object around a point."""
        corners = self._corners
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        distance = np.linalg.norm(corners.mean(axis=1) - point, axis=1)
        near = distance <= max(0.05 * self.longest_side, float(distance.min()) * 1.001)
        normal = area[near].sum(axis=0)
        length = np.linalg.norm(normal)
        return normal / length if length > 0 else _UP.astype(np.float64)


def upright(normal: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that takes +y to `normal`, and turns no more than that needs."""
    if normal[1] > 1 - 1e-9:
        return np.eye(3)
    if normal[1] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(_UP, normal)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + normal[1])
