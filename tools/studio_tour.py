"""docs/images/studio_tour.webp: a mesh is opened in the studio, a crown grows on it, and is taken away.

    python tools/studio_tour.py [FOLDER]

Needs chromium, `npm install` in tools/viewers, and viser. All pictures are of the real page, quick settings; how long
each is shown has nothing to do with how long it took. With FOLDER, they are kept there.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from studio_process import ROOT, driven, served, upward_drag

TOUR = ROOT / "docs" / "images" / "studio_tour.webp"
SIZE = (1180, 760)
"""Of the browser's window, pixels."""
STRIP = 40
"""Height of the words below each picture."""
QUALITY = 80
UPWARDS = 0.05
"""How far the region is moved, canonical units."""


def write_cat(path: Path) -> None:
    """The shipped cat as a GLB, as somebody else may have it."""
    from fd_mitsuba.scene.load_scene import load_edit_scene
    from fd_mitsuba.studio.base_glb import base_glb

    path.write_bytes(base_glb(load_edit_scene(ROOT / "scenes" / "cat" / "scene.xml")))


def drag_of_the_region(mesh: Path, scratch: Path) -> list[tuple[float, float]]:
    """Where the mouse moves the gizmo of the region that the page puts on a mesh."""
    from fd_mitsuba.api import import_asset
    from fd_mitsuba.scene.load_scene import load_edit_scene
    from fd_mitsuba.studio.region_list import RegionList

    regions = RegionList.of_scene(load_edit_scene(import_asset(mesh, scratch).scene))
    (pose,) = regions.poses.values()
    return upward_drag(regions.frame.to_canonical(np.array(pose.centre)), UPWARDS, *SIZE)


def animation(folder: Path, shots: list[dict[str, Any]]) -> None:
    """Write the pictures, with their words below, as one."""
    font = ImageFont.load_default(22)
    frames = []
    for shot in shots:
        frame = Image.new("RGB", (SIZE[0], SIZE[1] + STRIP), (34, 38, 46))
        frame.paste(Image.open(folder / shot["file"]).convert("RGB"))
        ImageDraw.Draw(frame).text((16, SIZE[1] + STRIP / 2), shot["words"], "white", font, anchor="lm")
        frames.append(frame)
    lengths = [shot["milliseconds"] for shot in shots]
    options = {"quality": QUALITY, "method": 4, "loop": 0}
    frames[0].save(TOUR, save_all=True, append_images=frames[1:], duration=lengths, **options)
    print(f"{TOUR}: {len(frames)} pictures, {sum(lengths) / 1000:.0f} s, {TOUR.stat().st_size // 1024} KB")


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_cat(folder / "cat.glb")
    options = {
        "width": SIZE[0],
        "height": SIZE[1],
        "mesh": str(folder / "cat.glb"),
        "prompt": "a cat with a crown",
        "told": "cat with a crown",
        "drag": drag_of_the_region(folder / "cat.glb", folder / "placed"),
        "every": 20,
    }
    with served("scenes/snowman/scene.xml", folder / "work") as url:
        shots = driven("studio_tour.mjs", url, folder, options=options)
    animation(folder, shots)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
