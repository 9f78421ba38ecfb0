"""What one guidance call with the built-in priors costs: `python benchmarks/guidance_call.py [--json] [--repeats N]`.

Four views as a run's step gives them, with the quick settings and all cores; the median of the calls after a warm-up.

    coarse_seconds      normals and coverage at the latents' size, 32 x 32 pixels a view
    refined_seconds     normals of 256 x 256 pixels a view, through the VAE's encoder
    appearance_seconds  colours and shine, 32 x 32 pixels a view
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores()

import numpy as np  # noqa: E402
import torch  # noqa: E402
from machine import print_figures  # noqa: E402

from fd_mitsuba.config import RunConfig  # noqa: E402
from fd_mitsuba.guidance.diffusion import DiffusionGuidance  # noqa: E402
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews, Phase  # noqa: E402

AZIMUTHS, ELEVATIONS = [10.0, 100.0, 190.0, 280.0], [15.0] * 4


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    config = RunConfig.load(ROOT / "configs" / "quick.toml")
    shapes = DiffusionGuidance.load(config.guidance)
    colours = shapes.for_appearance(config.appearance)
    for guidance in (shapes, colours):
        guidance.set_prompt("a cat with a crown")

    def shape_call(phase: Phase) -> Callable[[int], None]:
        size = shapes.picture_size(phase)
        pictures = torch.rand(4, 5, size, size, generator=torch.Generator().manual_seed(0))
        views = GuidanceViews(pictures.requires_grad_(), pictures.detach(), AZIMUTHS, ELEVATIONS)
        return lambda step: shapes.guide(views, step, 100, phase, seed=0).loss.backward()

    size = colours.appearance_size
    layers = torch.rand(9, 4, 1, size, size, generator=torch.Generator().manual_seed(0))
    pictures = torch.cat(list(layers[:3]), dim=1).requires_grad_()
    views = AppearanceViews(
        pictures, torch.cat(list(layers[3:6]), dim=1), layers[6], layers[7], layers[8], AZIMUTHS, ELEVATIONS
    )
    figures = {
        "coarse_seconds": timed(shape_call("coarse"), options.repeats),
        "refined_seconds": timed(shape_call("refined"), options.repeats),
        "appearance_seconds": timed(
            lambda step: colours.guide_appearance(views, step, 100, seed=0).loss.backward(), options.repeats
        ),
        "coarse_view": shapes.picture_size("coarse"),
        "refined_view": shapes.picture_size("refined"),
    }
    print_figures(figures, options.json)
    return 0


def timed(call: Callable[[int], None], repeats: int) -> float:
    """Median seconds of `repeats` calls after two."""
    seconds = []
    for step in range(repeats + 2):
        started = time.perf_counter()
        call(step)
        seconds.append(time.perf_counter() - started)
    return round(float(np.median(seconds[2:])), 4)


if __name__ == "__main__":
    sys.exit(main())
