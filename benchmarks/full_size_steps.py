"""What steps cost beside a large diffusion model: `python benchmarks/full_size_steps.py [--json] [--only KIND]`.

The pegasus scene with `configs/paper.toml`: four views of 512 x 512 pixels, in the refined phase with 1 sample and as
many outline points a pixel, in the appearance stage with the samples that the settings name. No diffusion network: the
image loss is a random linear functional of the pictures, another one at every step. The parts are the focal regions
themselves. Medians of whole optimiser steps, in turns:

    refined_seconds, appearance_seconds            on the clock
    refined_cpu_seconds, appearance_cpu_seconds    of all threads of this process
    every_pixel_seconds, every_pixel_cpu_seconds   the appearance step with rays through all pixels, those too that
                                                   cannot see the object: the same pictures

Under `torchrun --nproc-per-node 2` the views are shared out, and the first process prints its own figures. For a
comparison give each process one thread, and one core: `-t 1`.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.processes import processes  # noqa: E402
from fd_mitsuba.backend.threads import share_cores  # noqa: E402

SIZE, WARM_UP_STEPS = 512, 2


class LinearGuidance:
    """Stands in for a diffusion model: sum of pictures times fixed random weights of the step."""

    needs_base, view_grid, normal_space, appearance_size = False, 1, None, SIZE

    def picture_size(self, phase: str) -> int:
        """The same in all phases."""
        return SIZE

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Every word is as good as any other."""
        return []

    def guide(self, views: Any, step: int, steps_total: int, phase: str, seed: int) -> Any:
        """A loss whose derivative by every pixel is a random number of the size that SDS gives."""
        import torch

        from fd_mitsuba.guidance.interface import GuidanceResult

        shape = (len(views.pictures) * processes().count, *views.pictures.shape[1:])
        weights = torch.randn(shape, generator=torch.Generator().manual_seed(step))[views.share]
        return GuidanceResult((views.pictures * weights).sum() / SIZE**2 / shape[0])

    def guide_appearance(self, views: Any, step: int, steps_total: int, seed: int) -> Any:
        """The same for colours."""
        return self.guide(views, step, steps_total, "appearance", seed)


def make_steps(only: str | None, overrides: list[str]) -> dict[str, Callable[[int], Any]]:
    """Kind of step -> what makes a step of a number."""
    from fd_mitsuba.config import RunConfig
    from fd_mitsuba.scene.load_scene import load_edit_scene
    from fd_mitsuba.training.appearance_stage import AppearanceStage
    from fd_mitsuba.training.geometry_stage import GeometryStage

    scene = load_edit_scene(ROOT / "scenes" / "pegasus" / "scene.xml", {})
    config = RunConfig.load(ROOT / "configs" / "paper.toml", ["geometry.coarse_fraction=0", *overrides])
    kinds: dict[str, Callable[[int], Any]] = {}
    if only != "appearance":
        kinds["refined"] = GeometryStage(scene, config, LinearGuidance()).step  # type: ignore[arg-type]
    if only != "refined":
        parts = {region.name: region.surface() for region in scene.regions}
        stage = AppearanceStage(scene, config, parts, LinearGuidance(), say=lambda _: None)  # type: ignore[arg-type]
        kinds["appearance"] = stage.step
        kinds["every_pixel"] = lambda number: every_pixel(stage.step, number)
    return kinds


def every_pixel(step: Callable[[int], Any], number: int) -> Any:
    """A step that traces rays through all pixels."""
    import numpy as np

    from fd_mitsuba.render import gbuffer

    some = gbuffer.pixels_within
    gbuffer.pixels_within = lambda _, views: np.arange(views.count * views.size**2)
    try:
        return step(number)
    finally:
        gbuffer.pixels_within = some


def measure(kinds: dict[str, Callable[[int], Any]], repeats: int) -> dict[str, Any]:
    """The figures of the module's docstring."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
    for number in range(WARM_UP_STEPS + repeats):
        for name, step in kinds.items():
            processes().wait()
            began, cpu = time.perf_counter(), time.process_time()
            step(number)
            spent[name].append((time.perf_counter() - began, time.process_time() - cpu))
    figures: dict[str, Any] = {"processes": processes().count}
    for name, rows in spent.items():
        seconds, cpu_seconds = zip(*rows[WARM_UP_STEPS:], strict=True)
        figures[f"{name}_seconds"] = round(statistics.median(seconds), 3)
        figures[f"{name}_cpu_seconds"] = round(statistics.median(cpu_seconds), 3)
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Cost of steps at 512 pixels, without the diffusion network.")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--only", choices=("refined", "appearance"), help="one kind of step")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("-t", "--threads", type=int, default=0, help="as of fd_mitsuba")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of fd_mitsuba run")
    options = parser.parse_args()
    share_cores(options.threads)
    figures = measure(make_steps(options.only, options.set), options.repeats)
    if processes().writes:
        from machine import print_figures

        print_figures(figures, options.json)


if __name__ == "__main__":
    main()
