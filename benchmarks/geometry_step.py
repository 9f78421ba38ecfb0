"""What a step of the geometry stage costs: `python benchmarks/geometry_step.py [--json] [--memory [STEPS]]`.

Four views of 64 x 64 pixels, 4 samples and 1 outline point a pixel, the default grid, the pegasus scene, and no
diffusion network: the image loss is a random linear functional of the pictures, another one at every step, so that the
part wanders and its topology changes. Times are medians of whole optimiser steps. Three kinds of step take turns:

    seconds            `GeometryStage.step` on the default grid
    plain_seconds      the plain reference: hash grid at every vertex, naive marching tetrahedra over all of them, a
                       scene made anew with the stock projective integrator (`plain_reference`), same losses, same
                       optimiser
    fine_over_default  median over pairs of `GeometryStage.step` on a grid of 128 cells a side, same regions, and the
                       default step just before it

`kernels_compiled` counts the kernels that Dr.Jit did not have yet in 20 steps after 5 to warm up.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores()

import torch  # noqa: E402
from machine import kernels_compiled, print_figures, resident_mb  # noqa: E402
from plain_reference import render_plain  # noqa: E402

from fd_mitsuba.config import RunConfig  # noqa: E402
from fd_mitsuba.guidance.interface import GuidanceResult, GuidanceViews, Phase  # noqa: E402
from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402
from fd_mitsuba.training.geometry_stage import GeometryStage  # noqa: E402

PICTURE_SIZE = 64
WARM_UP_STEPS, COUNTED_STEPS = 5, 20
FINE_RESOLUTION = 128


class LinearGuidance:
    """Stands in for a diffusion model: sum of pictures times fixed random weights of the step."""

    needs_base, view_grid, normal_space = False, 1, None

    def picture_size(self, phase: Phase) -> int:
        """The same in both phases."""
        return PICTURE_SIZE

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Every word is as good as any other."""
        return []

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: Phase, seed: int) -> GuidanceResult:
        """A loss whose derivative by every pixel is a random number of the size that SDS gives."""
        weights = torch.randn(views.pictures.shape, generator=torch.Generator().manual_seed(step))
        return GuidanceResult((views.pictures * weights).sum() / len(views.pictures))


def make_stage(scene: EditScene, resolution: int) -> GeometryStage:
    """A stage that never leaves the coarse phase; all other settings are the defaults."""
    config = RunConfig()
    geometry = config.geometry.model_copy(
        update={"grid_resolution": resolution, "steps": 1_000_000, "coarse_fraction": 1.0}
    )
    return GeometryStage(scene, config.model_copy(update={"geometry": geometry}), LinearGuidance())


def plain_step(stage: GeometryStage, step: int) -> None:
    """The same step by the shortest code that can be written."""
    geometry = stage.config.geometry
    cameras, _ = stage.cameras(step)
    asked = stage.field_losses.ask(step)
    surface = stage.extractor.extract_plain(stage.field, asked.drawn)
    pictures = render_plain(
        surface.vertices, surface.faces, surface.part_weight, cameras, step,
        PICTURE_SIZE, geometry.spp, geometry.silhouette_spp,
    )  # fmt: skip
    views = GuidanceViews(pictures, None, cameras.azimuth_deg, cameras.elevation_deg)
    losses = {"sds": stage.guidance.guide(views, step, 1, "coarse", 0).loss}
    losses.update(stage.field_losses(surface.sample_sdf, asked))
    total = sum(getattr(geometry, f"lambda_{name}") * loss for name, loss in losses.items())
    stage.optimiser.zero_grad(set_to_none=True)
    total.backward()
    stage.optimiser.step()


class Runner:
    """Runs a stage's steps one after another and keeps their times."""

    def __init__(self, step: Callable[[int], Any]) -> None:
        self._step, self._number = step, 0
        self.seconds: list[float] = []

    def run(self, count: int = 1, keep: bool = True) -> None:
        """`count` more steps."""
        for _ in range(count):
            began = time.perf_counter()
            self._step(self._number)
            self._number += 1
            if keep:
                self.seconds.append(time.perf_counter() - began)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)


@contextmanager
def stopwatch(stage: GeometryStage) -> Iterator[Counter[str]]:
    """Seconds spent in the large pieces of `stage.step` while open."""
    spent: Counter[str] = Counter()

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            result = function(*args, **kwargs)
            spent[name] += time.perf_counter() - began
            return result

        return call

    extractor, backward = stage.extractor, torch.Tensor.backward

    class Timed:
        __call__ = staticmethod(timed("field_and_extraction", extractor.__call__))

        def __getattr__(self, name: str) -> Any:
            return getattr(extractor, name)

    stage.extractor = Timed()  # type: ignore[assignment]
    stage._render = timed("render", stage._render)  # type: ignore[method-assign]
    torch.Tensor.backward = timed("backward", backward)  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        torch.Tensor.backward = backward  # type: ignore[method-assign]
        del stage._render
        stage.extractor = extractor


def breakdown_ms(stage: GeometryStage, runner: Runner, steps: int) -> dict[str, float]:
    """Mean milliseconds a step of each piece."""
    with stopwatch(stage) as spent:
        began = time.perf_counter()
        runner.run(steps, keep=False)
        whole = time.perf_counter() - began
    result = {name: spent[name] for name in ("field_and_extraction", "render", "backward")}
    result["losses_and_optimiser"] = whole - sum(result.values())
    return {name: round(1000 * value / steps, 1) for name, value in result.items()}


def measure(scene: EditScene, repeats: int, plain_repeats: int) -> dict[str, Any]:
    """The figures of the module's docstring."""
    stage, fine = make_stage(scene, RunConfig().geometry.grid_resolution), make_stage(scene, FINE_RESOLUTION)
    fast = Runner(stage.step)
    fast.run(WARM_UP_STEPS, keep=False)
    compiled = kernels_compiled(lambda: fast.run(COUNTED_STEPS))
    detailed = Runner(fine.step)
    detailed.run(WARM_UP_STEPS, keep=False)
    for _ in range(repeats):
        fast.run()
        detailed.run()
    fine_ratios = [a / b for a, b in zip(detailed.seconds, fast.seconds[-repeats:], strict=True)]
    plain_stage = make_stage(scene, stage.grid.resolution)
    plain = Runner(lambda step: plain_step(plain_stage, step))
    plain.run(1, keep=False)
    for _ in range(plain_repeats):
        fast.run(3)
        plain.run()
    pieces = breakdown_ms(stage, fast, 10)
    surface = stage.surface()
    return {
        "seconds": round(fast.median, 4),
        "plain_seconds": round(plain.median, 3),
        "ratio": round(plain.median / fast.median, 1),
        "fine_over_default": round(statistics.median(fine_ratios), 2),
        "kernels_compiled": compiled,
        "breakdown_ms": pieces,
        "breakdown_fine_ms": breakdown_ms(fine, detailed, 5),
        "fine_seconds": round(detailed.median, 4),
        "seconds_10_to_90_percent": [round(value, 4) for value in statistics.quantiles(fast.seconds, n=10)[::8]],
        "faces": len(surface.faces),
        "faces_static": stage.extractor.static_faces,
        "active_vertices": len(stage.extractor.active_index),
    }


def measure_memory(scene: EditScene, steps: int) -> dict[str, Any]:
    """Growth of resident memory over `steps` steps of changing topology, after 20 to warm up."""
    stage = make_stage(scene, RunConfig().geometry.grid_resolution)
    runner = Runner(stage.step)
    runner.run(20)
    start, seen = resident_mb(), set()
    for _ in range(steps):
        runner.run()
        with torch.no_grad():
            seen.add(len(stage.surface().faces) if len(runner.seconds) % 50 == 0 else 0)
    return {
        "memory_start_mb": round(start, 1),
        "memory_growth_mb": round(resident_mb() - start, 1),
        "steps": steps,
        "face_counts_seen": len(seen - {0}),
        "seconds": round(runner.median, 4),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Cost of a step of the geometry stage, without the diffusion network.")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--memory", nargs="?", type=int, const=1000, metavar="STEPS", help="memory growth instead")
    parser.add_argument("--scene", default=str(ROOT / "scenes" / "pegasus" / "scene.xml"))
    parser.add_argument("--repeats", type=int, default=10, help="steps of each grid that take turns")
    parser.add_argument("--plain-repeats", type=int, default=3, help="steps of the plain reference")
    options = parser.parse_args()
    scene = load_edit_scene(options.scene, {})
    if options.memory is not None:
        result = measure_memory(scene, options.memory)
    else:
        result = measure(scene, options.repeats, options.plain_repeats)
    print_figures(result, options.json)


if __name__ == "__main__":
    main()
