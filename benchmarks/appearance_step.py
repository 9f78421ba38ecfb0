"""What a step of the appearance stage costs: `python benchmarks/appearance_step.py [--json] [--memory [STEPS]]`.

Four views of 128 x 128 pixels, 16 samples a pixel, the pegasus scene with a ball for a part, direct light, and no
diffusion network: the image loss is a random linear functional of the pictures, another one at every step. Times are
medians of whole optimiser steps: random cameras, primary rays, field, shading, backward, AdamW. Two kinds take turns:

    seconds        the field at the part's pixels, `AppearancePass`
    plain_seconds  the plain reference: the field baked to a texture of 512 x 512 texels, one `mi.render` of the stock
                   `prb` integrator for each view, same samples, same loss, same optimiser

`kernels_compiled` counts the kernels that Dr.Jit did not have yet in 20 steps after 3 to warm up.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores()

import torch  # noqa: E402
from machine import kernels_compiled, print_figures, resident_mb  # noqa: E402
from plain_appearance import PlainAppearance, uv_ball  # noqa: E402

from fd_mitsuba.config import CamerasConfig  # noqa: E402
from fd_mitsuba.fields.texture import TextureField  # noqa: E402
from fd_mitsuba.render.appearance_pass import AppearancePass  # noqa: E402
from fd_mitsuba.render.part_shading import PartShading  # noqa: E402
from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402
from fd_mitsuba.scene.triangle_mesh import TriangleMesh  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch, sample_views  # noqa: E402

SIZE, SPP, VIEWS = 128, 16, 4
WARM_UP_STEPS, COUNTED_STEPS = 3, 20
FEEDS = {name: name for name in ("base_color", "roughness", "metallic")}


class Bench:
    """A field, its optimiser, and the two ways to make a step."""

    def __init__(self, scene: EditScene) -> None:
        vertices, faces, uv = uv_ball(centre=(0.4, 0.5, 0.1), radius=0.35)
        self.field = TextureField(seed=0)
        self.optimiser = torch.optim.AdamW(self.field.parameters(), lr=1e-2)
        part = TriangleMesh("part", vertices, faces)
        self.fast = AppearancePass(scene, {"part": part}, PartShading({"type": "principled"}, FEEDS), SIZE, SPP)
        self.plain = PlainAppearance(scene, vertices, faces, uv, SIZE, SPP)
        self.step_number, self.points_seen = 0, 0

    def fast_step(self) -> None:
        """One step of the product."""
        cameras = self._cameras()
        gbuffer = self.fast.trace(cameras, self.step_number)
        values = self.field(gbuffer.points)
        self.points_seen = len(gbuffer.points)
        pictures = self.fast.render(
            gbuffer, values.base_color, values.roughness, values.metallic, values.normal, self.step_number
        )
        self._learn(pictures.merged)

    def plain_step(self) -> None:
        """The same by the shortest code that can be written; the normals stay as they are."""
        cameras = self._cameras()
        values = self.field(self.plain.texel_points)
        self._learn(self.plain.render(values.base_color, values.roughness, values.metallic, cameras, self.step_number))

    def timed(self, step: Any) -> float:
        began = time.perf_counter()
        step()
        return time.perf_counter() - began

    def _cameras(self) -> CameraBatch:
        self.step_number += VIEWS
        return sample_views(CamerasConfig(), VIEWS, self.step_number)

    def _learn(self, pictures: torch.Tensor) -> None:
        weights = torch.randn(pictures.shape, generator=torch.Generator().manual_seed(self.step_number))
        self.optimiser.zero_grad(set_to_none=True)
        (pictures * weights).mean().backward()
        self.optimiser.step()


def measure(bench: Bench, repeats: int, plain_repeats: int) -> dict[str, Any]:
    """The figures of the module's docstring."""
    for _ in range(WARM_UP_STEPS):
        bench.fast_step()
    compiled = kernels_compiled(lambda: [bench.fast_step() for _ in range(COUNTED_STEPS)])
    bench.plain_step()
    fast, plain = [], []
    for number in range(max(repeats, plain_repeats)):
        if number < repeats:
            fast.append(bench.timed(bench.fast_step))
        if number < plain_repeats:
            plain.append(bench.timed(bench.plain_step))
    seconds, plain_seconds = statistics.median(fast), statistics.median(plain)
    return {
        "seconds": round(seconds, 4),
        "plain_seconds": round(plain_seconds, 3),
        "ratio": round(plain_seconds / seconds, 1),
        "kernels_compiled": compiled,
        "part_pixels": bench.points_seen,
    }


def measure_memory(bench: Bench, steps: int) -> dict[str, Any]:
    """Growth of resident memory over `steps` steps, after 20 to warm up."""
    for _ in range(20):
        bench.fast_step()
    start = resident_mb()
    seconds = [bench.timed(bench.fast_step) for _ in range(steps)]
    return {
        "memory_start_mb": round(start, 1),
        "memory_growth_mb": round(resident_mb() - start, 1),
        "steps": steps,
        "seconds": round(statistics.median(seconds), 4),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Cost of a step of the appearance stage, without a diffusion network.")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--memory", nargs="?", type=int, const=500, metavar="STEPS", help="memory growth instead")
    parser.add_argument("--scene", default=str(ROOT / "scenes" / "pegasus" / "scene.xml"))
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--plain-repeats", type=int, default=3)
    options = parser.parse_args()
    bench = Bench(load_edit_scene(options.scene, {}))
    if options.memory is not None:
        result = measure_memory(bench, options.memory)
    else:
        result = measure(bench, options.repeats, options.plain_repeats)
    print_figures(result, options.json)


if __name__ == "__main__":
    main()
