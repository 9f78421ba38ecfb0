"""How close a run's photographs are to what many samples show, with the denoiser and with the same seconds without.

    python benchmarks/photograph_noise.py RUN [--reference 4096] [--window 256] [--spp 2 4 8]
    python benchmarks/photograph_noise.py RUN --tiles 16 [--reference 4096] [--spp 4 8]

Compares a square window of the photograph around the part, in sRGB with the run's exposure: PSNR in decibels, and the
brightest excess over the reference (a firefly would be one of more than .2). With --tiles the whole photograph instead,
as the run makes it, at so many squares of 64 pixels that are spread over it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "src"))

from fd_mitsuba.runs.photographs import PhotoViews  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.viewing.denoising import denoised  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--reference", type=int, default=4096, help="samples a pixel of the reference")
    parser.add_argument("--size", type=int, default=1024, help="pixels a side of the photograph")
    parser.add_argument("--window", type=int, default=256, help="pixels a side of what is compared")
    parser.add_argument("--tiles", type=int, help="squares of 64 pixels of the whole photograph, such as 16")
    parser.add_argument("--spp", type=int, nargs="+", default=[2, 4, 8])
    options = parser.parse_args()
    scene, _ = saved_run(options.run)
    views = PhotoViews.of(scene, options.run)
    if options.tiles:
        whole(views, options)
        return
    for name, camera in (("beauty", views.camera), ("closeup", views.close)):
        box = _window(views, name, camera, options.size, options.window)
        truth = _shown(views, views.after.radiance(camera, options.size, options.reference, 99, box))
        views.after.radiance(camera, options.size, 1, 0, box)
        for spp in options.spp:
            start = time.process_time()
            grainy = views.after.radiance(camera, options.size, spp, 1, box)
            rendered = time.process_time()
            guides = views.after.guides(camera, options.size, 1, box)
            rows = {"grain": (grainy, rendered - start)}
            before = time.process_time()
            rows["clean"] = (denoised(grainy, *guides), time.process_time() - before + rendered - start)
            seconds = rows["clean"][1]
            more = max(spp, round(spp * seconds / max(rows["grain"][1], 1e-6)))
            rows["same seconds"] = (views.after.radiance(camera, options.size, more, 2, box), seconds)
            for kind, (image, spent) in rows.items():
                found = _shown(views, image)
                row = {"image": name, "spp": spp, "kind": kind, "psnr_db": round(_psnr(found, truth), 2)}
                row |= {"excess": round(float((found - truth).max()), 3), "cpu_seconds": round(spent, 2)}
                print(json.dumps(row), flush=True)


def whole(views: PhotoViews, options: argparse.Namespace) -> None:
    """Prints the PSNR of whole photographs, by random squares, one in each cell of a lattice."""
    side, cells = 64, int(np.ceil(np.sqrt(options.tiles)))
    rng, room = np.random.default_rng(0), options.size / cells - 64
    for name, camera in (("beauty", views.camera), ("closeup", views.close)):
        lows = [
            (np.array(cell) * options.size / cells + rng.random(2) * room).astype(int)
            for cell in np.ndindex(cells, cells)
        ]
        boxes = [tuple(slice(low, low + side) for low in pair) for pair in lows]
        truth = [_shown(views, views.after.radiance(camera, options.size, options.reference, 99, box)) for box in boxes]
        for spp in options.spp:
            start = time.process_time()
            found = _shown(views, views.after.photograph(camera, options.size, spp))
            spent = time.process_time() - start
            psnr = _psnr(np.stack([found[box] for box in boxes]), np.stack(truth))
            excess = max(float((found[box] - true).max()) for box, true in zip(boxes, truth, strict=True))
            row = {"image": name, "spp": spp, "kind": "whole", "psnr_db": round(psnr, 2), "excess": round(excess, 3)}
            print(json.dumps(row | {"cpu_seconds": round(spent, 2)}), flush=True)


def _window(views: PhotoViews, name: str, camera: object, size: int, side: int) -> tuple[slice, slice]:
    """The square of the photograph in whose middle the parts are; of the close-up its middle."""
    if name == "closeup":
        centre = np.full(2, size // 2)
    else:
        right, up, back = (axis[0].astype(np.float64) for axis in camera.basis())
        offset = views.close.target[0].astype(np.float64) - camera.target[0]
        depth = np.linalg.norm(camera.position[0] - camera.target[0]) - offset @ back
        reach = depth * np.tan(np.radians(camera.fov_deg[0]) / 2)
        centre = size / 2 * (1 + np.array([-(offset @ up), offset @ right]) / reach)
    low = np.clip(np.round(centre - side / 2), 0, size - side).astype(int)
    return slice(low[0], low[0] + side), slice(low[1], low[1] + side)


def _shown(views: PhotoViews, linear: np.ndarray) -> np.ndarray:
    return views.shown(linear).astype(np.float64) / 255


def _psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(max(((image - truth) ** 2).mean(), 1e-12)))


if __name__ == "__main__":
    main()
