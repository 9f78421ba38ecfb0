"""What `part.json` says about the exported parts: where they are, where they touch the base, what they are like."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fd_mitsuba.export.solid.contacts import contacts
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.export.solid.walls import measure_walls
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

RECORD_FORMAT = 1


def part_record(scene: EditScene, solids: dict[str, Solid], opened: Mapping[int, str | None] | None = None) -> dict:
    """Plain data for JSON about the parts' solids, which are given in the canonical frame.

    `canonical_to_user` is the (4, 4) matrix between the frames. For each part: `file`, the PLY in the user's frame;
    `bounds` and `anchor`, both in the user's frame and unit; `volume` in cubic user units; `gap` and `bridged` in the
    user's unit; `faces`, `manifold`, `islands_removed`. Of parts that are not cut out, `walls` in the user's unit (see
    `measure_walls`), and `contacts` with the base, among them ends that hang free, with a `gap` (see `contacts`). A
    part without faces is left out.

    Args:
        opened: where parts were cut out: number of a base shape that was cut -> file of what is left of it without the
            faces of the cut; None: nothing is.
    """
    base, scale = scene.base_canonical, 1.0 / scene.frame.scale
    distance = MeshDistance(base.vertices, base.faces)
    parts = {}
    for name, solid in solids.items():
        if not len(solid.faces):
            continue
        position, direction = anchor(solid, base, distance)
        corners = scene.frame.to_user(np.stack([solid.vertices.min(axis=0), solid.vertices.max(axis=0)]))
        parts[name] = {
            "file": part_file(name),
            "bounds": {"low": corners[0].tolist(), "high": corners[1].tolist()},
            "anchor": {"position": scene.frame.to_user(position).tolist(), "direction": direction.tolist()},
            "volume": solid.volume * scale**3,
            "faces": len(solid.faces),
            "manifold": solid.manifold,
            "gap": solid.gap(base) * scale,
            "bridged": solid.bridged * scale,
            "islands_removed": solid.islands_removed,
        }
        if opened is None:
            walls = measure_walls(solid, distance)
            if walls is not None:
                where = scene.frame.to_user(walls.position).tolist()
                sizes = {"least": walls.least * scale, "thin": walls.thin * scale}
                parts[name]["walls"] = sizes | {"position": where}
            parts[name]["contacts"] = [
                {"position": scene.frame.to_user(found.position).tolist(), "gap": found.gap * scale}
                for found in contacts(solid, distance)
            ]
    to_user = np.linalg.inv(scene.frame.matrix())
    record = {"format": RECORD_FORMAT, "canonical_to_user": to_user.tolist(), "parts": parts}
    if opened is not None:
        record["opened"] = {str(number): name for number, name in opened.items()}
    return record


def part_file(name: str) -> str:
    """The file name of a part's mesh in the export folder."""
    return f"part_{name}.ply"


def anchor(solid: Solid, base: TriangleMesh, distance: MeshDistance) -> tuple[np.ndarray, np.ndarray]:
    """Where and how the part grows out of the base: a position (3,) and a unit direction (3,), in the solid's frame.

    The position is the centroid of the solid's surface inside the base. That surface's area vector, the opposite of
    that of the rest since the solid is closed, points into the base: the direction is its opposite. Where nothing is
    inside the base, the two are the base's nearest point and the way from there.

    Args:
        distance: of the base.
    """
    corners = solid.vertices.astype(np.float64)[solid.faces]
    centres = corners.mean(axis=1)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    within = distance.inside(centres)
    middle = _centroid(corners)
    if within.any():
        weight = np.linalg.norm(areas[within], axis=1)
        position = weight @ centres[within] / weight.sum()
        direction, enough = -areas[within].sum(axis=0), 0.05 * weight.sum()
    else:
        closest = int(np.argmin(distance.unsigned(solid.vertices)))
        face, weights = distance.nearest(solid.vertices[closest : closest + 1])
        position = weights[0] @ base.vertices[base.faces[face[0]]]
        direction, enough = solid.vertices[closest] - position, 1e-6
    if np.linalg.norm(direction) <= enough:  # such as a ring around a leg: no side is the outer one
        direction = middle - position
    length = np.linalg.norm(direction)
    return position, direction / length if length > 0 else np.array([0.0, 1.0, 0.0])


def _centroid(corners: np.ndarray) -> np.ndarray:
    """The centre of mass (3,) of the closed solid with triangles `corners` (F, 3, 3)."""
    origin = corners.reshape(-1, 3).mean(axis=0)
    local = corners - origin
    volumes = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6
    if not volumes.sum() > 0:
        return origin
    return origin + volumes @ (local.sum(axis=1) / 4) / volumes.sum()
