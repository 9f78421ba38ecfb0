"""What it costs to export a large part: `python benchmarks/export_part.py [--json] [--faces N] [--texture-size N]`.

A lumpy ball of `--faces` triangles where the part of the pegasus scene grows, with an untrained texture field, written
in all four formats: atlas, baked pictures, files. Mitsuba and the scene are loaded before.

    seconds      wall time of `export_assets`
    cpu_seconds  processor time of all its threads, which other work on the machine does not change
    peak_mb      the most memory that the process has had, everything loaded included
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores()

import numpy as np  # noqa: E402
from machine import print_figures  # noqa: E402

from fd_mitsuba.backend.peak_memory import peak_memory_mb  # noqa: E402
from fd_mitsuba.config import RunConfig  # noqa: E402
from fd_mitsuba.export.assets import PartAsset, export_assets  # noqa: E402
from fd_mitsuba.fields.texture import TextureField  # noqa: E402
from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402


def lumpy_ball(faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and about `faces` triangles (F, 3) of a closed lumpy ball, on a grid of angles."""
    rows = max(round(np.sqrt(faces / 4)), 3)
    columns = 2 * rows
    polar, around = np.meshgrid(np.arange(1, rows) * np.pi / rows, np.arange(columns) * np.pi / rows, indexing="ij")
    radius = 1 + 0.15 * np.sin(5 * polar) * np.cos(4 * around)
    ring = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1)
    points = (radius[..., None] * ring).reshape(-1, 3)
    top, bottom = len(points), len(points) + 1
    here = np.arange(columns)
    after = (here + 1) % columns
    triangles = [np.stack([np.full(columns, top), here, after], axis=1)]
    for row in range(rows - 2):
        upper, lower = row * columns, (row + 1) * columns
        triangles.append(np.stack([upper + here, lower + here, lower + after], axis=1))
        triangles.append(np.stack([upper + here, lower + after, upper + after], axis=1))
    last = (rows - 2) * columns
    triangles.append(np.stack([last + after, last + here, np.full(columns, bottom)], axis=1))
    return np.concatenate([points, [[0, 1, 0], [0, -1, 0]]]), np.concatenate(triangles)


def measure(scene: EditScene, faces: int, texture_size: int) -> dict[str, Any]:
    """The figures of the module's docstring."""
    vertices, triangles = lumpy_ball(faces)
    centre = np.mean([region.bounds for region in scene.regions], axis=(0, 1))
    name = next(iter(scene.parts))
    part = PartAsset(scene.frame.to_user(0.3 * vertices + centre), triangles, TextureField(seed=0))
    before = peak_memory_mb()
    with tempfile.TemporaryDirectory() as folder:
        began, cpu = time.perf_counter(), time.process_time()
        written = export_assets(scene, RunConfig(), {name: part}, Path(folder), texture_size=texture_size)
        seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return {
        "faces": written["part_faces"][name],
        "texture_size": texture_size,
        "seconds": round(seconds, 2),
        "cpu_seconds": round(cpu_seconds, 2),
        "peak_mb": peak_memory_mb(),
        "before_mb": before,
        "written_mb": round(size / 2**20, 1),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time and memory of exporting a large part.")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--faces", type=int, default=100_000)
    parser.add_argument("--texture-size", type=int, default=1024)
    parser.add_argument("--scene", default=str(ROOT / "scenes" / "pegasus" / "scene.xml"))
    options = parser.parse_args()
    result = measure(load_edit_scene(options.scene, {}), options.faces, options.texture_size)
    print_figures(result, options.json)


if __name__ == "__main__":
    main()
