"""How good the surfaces of exported parts are: `python benchmarks/part_surface.py RUN... [--json]`.

A row for each part of each run folder; what was the training's own surface is in brackets.

    angle_p5, least     smallest angles of the triangles in degrees: 5th percentile, and the smallest of all
    off, off_max        distance of points on the triangles from the function's zero set, in cells of the training
    off_seen            the largest of those outside of the base; what is sunk in it nobody sees
    volume              outside of the base, over that of the training's surface, minus 1; sampled, to about .4 %
    meant               the same over that of the training's function, marched three times finer than the training does
    noise               mean angle in degrees between the shading normals and smoothed ones, outside of the base
    turn_p95            turning angle of the joint within a cell, 95th percentile, degrees; a circle of n cells: 360 / n
    sideways            the same without what the base's own surface turns
    notch               the deepest notch of the joint, in cells; curves counts closed curves
    notch_sideways      the same without what the base's own surface bends
    charts, used        of the atlas: how many, and which share of the square they cover
    seconds             processor time of the final surface
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "src")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from torch import Tensor  # noqa: E402

from fd_mitsuba.evaluation.joint import measure_joint  # noqa: E402
from fd_mitsuba.export.bake.chart_notches import charts_of  # noqa: E402
from fd_mitsuba.export.bake.shading_noise import surface_noise  # noqa: E402
from fd_mitsuba.export.bake.unwrap import unwrap  # noqa: E402
from fd_mitsuba.export.final_surface.final_part import final_part, part_function  # noqa: E402
from fd_mitsuba.export.final_surface.fine_lattice import refined  # noqa: E402
from fd_mitsuba.export.final_surface.part_function import PartFunction  # noqa: E402
from fd_mitsuba.export.final_surface.projection import project  # noqa: E402
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles  # noqa: E402
from fd_mitsuba.export.solid.part_solid import LatticePart, lattice_part, part_solid  # noqa: E402
from fd_mitsuba.export.solid.solid import Solid  # noqa: E402
from fd_mitsuba.fields.union import soft_union  # noqa: E402
from fd_mitsuba.runs.geometry_outcome import load_finished_stage  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.scene.mesh_distance import MeshDistance  # noqa: E402
from fd_mitsuba.scene.vertex_normals import vertex_normals  # noqa: E402

_POINTS, _VOLUME_POINTS = 20_000, 300_000


def measure(folder: Path) -> list[dict[str, Any]]:
    """The figures of the module's docstring."""
    scene, config = saved_run(folder)
    grown = load_finished_stage(scene, config, folder).grown()
    base, cell = MeshDistance(scene.base_canonical.vertices, scene.base_canonical.faces), grown.grid.spacing
    rows = []
    for name in scene.parts:
        coarse = part_solid(grown, name)
        start = time.process_time()
        part = final_part(grown, name, config.output.faces)
        seconds = time.process_time() - start
        solid = part.solid
        angles = smallest_angles(solid.vertices, solid.faces)
        lattice = lattice_part(grown, name)
        function = part_function(grown, lattice, 3)
        points = spread(solid.vertices, solid.faces, np.random.default_rng(0))
        feet, _, left = project(function.with_gradient, points, 0.2 * cell, 12, 1e-4 * cell)
        off = (np.linalg.norm(feet - points, axis=1) + left) / cell
        joint, was = (measure_joint(s.vertices, s.faces, base, cell) for s in (solid, coarse))
        atlas = unwrap(solid.vertices, solid.faces, config.output.texture_size, part.normals)
        corners = atlas.uv[atlas.faces]
        one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        row = {
            "run": folder.name,
            "faces": len(solid.faces),
            "manifold": solid.manifold,
            "angle_p5": float(np.percentile(angles, 5)),
            "least": float(angles.min()),
            "off": float(off.mean()),
            "off_max": float(off.max()),
            "off_seen": float(off[~base.inside(points)].max(initial=0)),
            "volume": shown_volume(solid, base) / shown_volume(coarse, base) - 1,
            "meant": shown_volume(solid, base) / shown_volume(meant_solid(function, lattice), base) - 1,
            "noise": surface_noise(solid.vertices, shown_faces(solid, base), part.normals),
            "noise_before": surface_noise(
                coarse.vertices, shown_faces(coarse, base), vertex_normals(coarse.vertices, coarse.faces)
            ),
            "curves": joint.curves,
            "turn_p95": percentile(joint.turning_deg),
            "sideways": percentile(joint.sideways_deg),
            "turn_before": percentile(was.turning_deg),
            "notch": float(joint.notches.max(initial=0)),
            "notch_sideways": float(joint.sideways_notches.max(initial=0)),
            "notch_before": float(was.notches.max(initial=0)),
            "gap": solid.gap(scene.base_canonical) / cell,
            "charts": len(np.unique(charts_of(atlas.faces, len(atlas.uv)))),
            "used": float(np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum() / 2),
            "seconds": seconds,
        }
        rows.append(row)
    return rows


class Trained(PartFunction):
    """What the training's grid marches, as a function of space: with the fillet that the training saw."""

    def _joined(self, base: Tensor, part: Tensor, away: Tensor, lower: Tensor | float) -> Tensor:
        fillet = soft_union(base, part, self.width, self.union_only_outside) - torch.maximum(base, part)
        return torch.maximum(base - lower, part) + fillet


def meant_solid(function: PartFunction, coarse: LatticePart) -> Solid:
    """What the training's grid would march if it were three times finer."""
    own: dict[str, Any] = {item.name: getattr(function, item.name) for item in fields(function)} | {
        "reach": coarse.reach
    }
    shape = (coarse.grid.side,) * 3
    made = refined(coarse.grid, torch.stack(coarse.fields).amin(dim=0).view(shape).numpy(), Trained(**own).values, 3)
    return Solid(*made.surface(made.values > 0)) if made else Solid(np.zeros((0, 3)), np.zeros((0, 3)))


def spread(vertices: np.ndarray, faces: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Points (N, 3) evenly on the triangles."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = random.choice(len(faces), _POINTS, p=area / area.sum())
    first, second = np.sqrt(random.random(_POINTS)), random.random(_POINTS)
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)
    return (weights[..., None] * corners[chosen]).sum(axis=1)


def shown_faces(solid: Solid, base: MeshDistance) -> np.ndarray:
    """The faces (F, 3) outside of the base."""
    return solid.faces[~base.inside(solid.vertices)[solid.faces].any(axis=1)]


def shown_volume(solid: Solid, base: MeshDistance) -> float:
    """The volume outside of the base: of points on a lattice in the solid's bounds."""
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    step = (np.prod(high - low) / _VOLUME_POINTS) ** (1 / 3)
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[MeshDistance(solid.vertices, solid.faces).inside(points)]
    return float((~base.inside(points)).sum()) * step**3


def percentile(values: np.ndarray) -> float:
    """The 95th; NaN without a curve."""
    return float(np.percentile(values, 95)) if len(values) else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--json", action="store_true", help="a line of JSON a part")
    options = parser.parse_args()
    for folder in options.runs:
        for row in measure(folder):
            if options.json:
                print(json.dumps(row, default=float), flush=True)
                continue
            print(
                f"{row['run']:12} faces {row['faces']:6} manifold {row['manifold']}  angle_p5 {row['angle_p5']:.1f} "
                f"least {row['least']:.1f}  off {row['off']:.4f} max {row['off_max']:.3f} "
                f"seen {row['off_seen']:.3f}  "
                f"volume {row['volume']:+.2%} meant {row['meant']:+.2%}  "
                f"noise {row['noise']:.2f} ({row['noise_before']:.2f})  curves {row['curves']} "
                f"turn_p95 {row['turn_p95']:.0f} ({row['turn_before']:.0f}) sideways {row['sideways']:.0f}  "
                f"notch {row['notch']:.2f} ({row['notch_before']:.2f}) sideways {row['notch_sideways']:.2f}  "
                f"gap {row['gap']:.2f}  charts {row['charts']} "
                f"used {row['used']:.0%}  {row['seconds']:.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
