"""Does stock Mitsuba show what we show? `python benchmarks/check_stock_render.py RUN [-o PICTURE.png] [--json]`

Renders the exported scene with the `mitsuba` program beside this Python, which knows nothing of this package, and the
run's fields with our own passes, from the same two cameras, with direct light. Only pixels that the object covers
count.
All but the first are relative to that, and means of absolute differences:

    mean          of the light that our picture has there
    difference    between our picture and stock Mitsuba's
    noise         what that would be by chance: of the differences of ours and of stock Mitsuba's own from a second
                  picture with other random numbers, the root of the mean square
    blocks, noise_blocks   the same for means over blocks of 8 x 8 pixels, where noise is small
    bias          difference of the two means of the whole

Exit code 1 if a difference is more than its noise and 1 % of the mean, or the bias is more than 1 %.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from machine import print_figures  # noqa: E402
from PIL import Image  # noqa: E402
from torch.nn.functional import avg_pool2d  # noqa: E402

from fd_mitsuba.backend.file_threads import file_threads  # noqa: E402
from fd_mitsuba.io.srgb import srgb_from_linear  # noqa: E402
from fd_mitsuba.runs.appearance_outcome import finished_appearance  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.scene.scene_file import ready_mitsuba  # noqa: E402
from fd_mitsuba.training.appearance_stage import AppearanceStage  # noqa: E402
from fd_mitsuba.viewing.lit_views import ring_cameras, some_cameras  # noqa: E402

SIZE, SPP, BLOCK = 128, 128, 8
FINER = 4
"""Our passes ask the field once a pixel, stock Mitsuba a texture at every sample; so ours are means of finer pixels."""
VIEWS = (1, 5)
"""Of a ring of eight: from the front left and from behind."""


def ours(stage: AppearanceStage, view: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Light (S, S, 3), and which pixels (S, S) the object covers."""
    cameras = some_cameras(ring_cameras(8, stage.aim), slice(view, view + 1))
    with torch.no_grad():
        gbuffer = stage.rendering.trace(cameras, seed, size=SIZE * FINER, spp=SPP // FINER**2)
        light = avg_pool2d(stage.render(gbuffer, stage.texture(gbuffer), seed).merged, FINER)[0]
        alpha = avg_pool2d(gbuffer.alpha, FINER)
    return light.permute(1, 2, 0).numpy(), alpha[0, 0].numpy() > 0.9999


def stock(stage: AppearanceStage, view: int, scene: Path, folder: Path, seed: int) -> np.ndarray:
    """The exported scene from the same camera, direct light only."""
    tree = ET.parse(scene)
    root = tree.getroot()
    root.find("integrator").find("integer[@name='max_depth']").set("value", "2")
    cameras = ring_cameras(8, stage.aim)
    place = {
        name: ", ".join(f"{value:.9g}" for value in stage.scene.frame.to_user(points[view : view + 1])[0])
        for name, points in (("origin", cameras.position), ("target", cameras.target))
    }
    sensor = root.find("sensor")
    sensor.find("transform/lookat").attrib |= place
    sensor.find("float[@name='fov']").set("value", f"{cameras.fov_deg[view]:.9g}")
    film = sensor.find("film")
    for name in ("width", "height"):
        film.find(f"integer[@name='{name}']").set("value", str(SIZE))
    ET.SubElement(film, "rfilter", {"type": "box"})
    sensor.find("sampler/integer").set("value", str(SPP))
    ET.SubElement(sensor.find("sampler"), "integer", {"name": "seed", "value": str(seed)})
    copy = scene.with_name("check_stock_render.xml")  # file names in it are relative
    try:
        tree.write(copy)
        # With fewer threads, Mitsuba 3.9 can wait forever on an EXR light.
        program = str(Path(sys.executable).with_name("mitsuba"))
        command = [program, "-m", "scalar_rgb", "-t", "4", str(copy), "-o", str(folder / "stock.exr")]
        subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    finally:
        copy.unlink(missing_ok=True)
    with file_threads():
        return np.array(ready_mitsuba().Bitmap(str(folder / "stock.exr")))[..., :3]


def compare(one: np.ndarray, other: np.ndarray, covered: np.ndarray) -> tuple[float, float]:
    """Mean absolute difference of pixels, and of blocks that are covered throughout."""
    apart = one - other
    count = SIZE // BLOCK

    def blocks(values: np.ndarray) -> np.ndarray:
        return values.reshape(count, BLOCK, count, BLOCK, -1).mean(axis=(1, 3))

    whole = blocks(covered[..., None].astype(float))[..., 0] == 1
    return float(np.abs(apart)[covered].mean()), float(np.abs(blocks(apart))[whole].mean())


def check(run: Path, picture: Path | None) -> dict[str, Any]:
    """The figures of the module's docstring; the mean over the views."""
    scene, config = saved_run(run)
    stage = finished_appearance(scene, config, run, max_depth=2)
    if stage is None:
        sys.exit(f"{run}: its appearance stage has not begun; run it with --stage appearance")
    rows, shown = [], []
    with tempfile.TemporaryDirectory() as folder:
        for view in VIEWS:
            first, covered = ours(stage, view, 0)
            second, _ = ours(stage, view, 1000)
            theirs, again = (
                stock(stage, view, run.resolve() / "export" / "mitsuba" / "scene.xml", Path(folder), seed)
                for seed in (7, 8)
            )
            mean = float(first[covered].mean())
            apart = np.array(compare(first, theirs, covered))
            noise = np.sqrt(
                (np.square(compare(first, second, covered)) + np.square(compare(theirs, again, covered))) / 2
            )
            bias = abs(float(theirs[covered].mean()) - mean)
            rows.append(np.array([apart[0], noise[0], apart[1], noise[1], bias]) / mean)
            shown.append(np.concatenate([first, theirs * covered[..., None]], axis=1) / mean)
    if picture is not None:
        Image.fromarray((255 * srgb_from_linear(0.4 * np.concatenate(shown))).astype(np.uint8)).save(picture)
    names = ("difference", "noise", "blocks", "noise_blocks", "bias")
    found: dict[str, Any] = {"mean": mean} | dict(zip(names, np.mean(rows, axis=0).round(5).tolist(), strict=True))
    near = found["difference"] <= found["noise"] + 0.01 and found["blocks"] <= found["noise_blocks"] + 0.01
    found["equal"] = near and found["bias"] <= 0.01
    return found


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Compares stock Mitsuba's picture of an export with our own.")
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="picture: ours left, stock Mitsuba right")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    found = check(options.run, options.output)
    print_figures(found, options.json)
    return 0 if found["equal"] else 1


if __name__ == "__main__":
    sys.exit(main())
