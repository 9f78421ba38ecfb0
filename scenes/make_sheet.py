"""Draws `scenes/scenes.jpg`, one tile a scene with its focal regions in orange: `python scenes/make_sheet.py`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageFilter, ImageFont

from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.scene_file import SceneFile

HERE = Path(__file__).resolve().parent
COLUMNS, TILE, CAPTION, MARGIN, SPP = 5, 240, 40, 8, 64
FOV_DEG, DISTANCE, ELEVATION_DEG, PAPER = 42.0, 3.1, 16.0, 0.93
AZIMUTH_DEG = {"teddy_backpack": 100.0, "superhero": 145.0}
"""Where the part is best seen; 35 degrees for the others. Azimuths are those of `fd_mitsuba.conventions`."""


def tile(name: str) -> Image.Image:
    """The base, path-traced under the scene's own light and exposed to fit, with the regions laid over it."""
    scene = load_edit_scene(HERE / name / "scene.xml")
    azimuth, elevation = np.deg2rad([AZIMUTH_DEG.get(name, 35.0), ELEVATION_DEG])
    back = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    position = scene.frame.to_user((DISTANCE * back)[None])[0]
    target = scene.frame.to_user(np.zeros((1, 3)))[0]
    file = SceneFile(scene.path)
    mi = file.mi
    loaded = file.instantiate(without=("focal_region", "sensor", "integrator"))
    sensor = {
        "type": "perspective",
        "fov": FOV_DEG,
        "to_world": mi.ScalarTransform4f().look_at(origin=position.tolist(), target=target.tolist(), up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": TILE, "height": TILE, "pixel_format": "rgba"},
    }
    sensor["near_clip"], sensor["far_clip"] = 1e-2 / scene.frame.scale, 1e2 / scene.frame.scale
    path = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    picture = np.array(mi.render(loaded, sensor=mi.load_dict(sensor), integrator=path, spp=SPP, seed=0))
    alpha = np.clip(picture[..., 3:], 0, 1)
    colour = picture[..., :3]
    colour = colour * (0.5 / max(float(np.percentile(colour[alpha[..., 0] > 0.9].mean(axis=1), 85)), 1e-6))
    colour = np.clip(
        np.where(colour < 0.0031308, 12.92 * colour, 1.055 * np.maximum(colour, 1e-9) ** (1 / 2.4) - 0.055), 0, 1
    )
    pixels = colour * alpha + PAPER * (1 - alpha)
    return _with_regions(Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)), scene, back)


def _with_regions(picture: Image.Image, scene: EditScene, back: np.ndarray) -> Image.Image:
    """The picture with every region's outline and a tint inside it."""
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    for region in scene.regions:
        surface = region.surface(4)
        x, y, z = (surface.vertices @ axes).T
        zoom = TILE / 2 / np.tan(np.deg2rad(FOV_DEG) / 2) / (DISTANCE - z)
        at = np.stack([TILE / 2 + x * zoom, TILE / 2 - y * zoom], axis=1)
        inside = Image.new("L", picture.size)
        draw = ImageDraw.Draw(inside)
        for corners in at[surface.faces]:
            draw.polygon([tuple(corner) for corner in corners], fill=255)
        rim = ImageChops.subtract(inside, inside.filter(ImageFilter.MinFilter(3)))
        for mask, opacity in ((inside, 0.22), (rim, 0.9)):
            picture = Image.composite(
                Image.new("RGB", picture.size, (240, 125, 30)), picture, mask.point(lambda v, o=opacity: int(v * o))
            )
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "scenes", nargs="*", help="draw these again; the others are taken from --tiles if they are there"
    )
    parser.add_argument("--tiles", type=Path, help="folder that keeps the tiles")
    arguments = parser.parse_args()
    folder = arguments.tiles or Path(tempfile.mkdtemp())
    names = sorted(path.parent.name for path in HERE.glob("*/scene.xml"))
    rows = -(-len(names) // COLUMNS)
    size = (COLUMNS * (TILE + MARGIN) + MARGIN, rows * (TILE + CAPTION + MARGIN) + MARGIN)
    sheet = Image.new("RGB", size, "white")
    draw, font, small = ImageDraw.Draw(sheet), ImageFont.load_default(size=14), ImageFont.load_default(size=11)
    for index, name in enumerate(names):
        kept = folder / f"{name}.png"
        if name in arguments.scenes or not kept.exists():
            tile(name).save(kept)
            print(name, flush=True)
        x = MARGIN + index % COLUMNS * (TILE + MARGIN)
        y = MARGIN + index // COLUMNS * (TILE + CAPTION + MARGIN)
        with Image.open(kept) as picture:
            sheet.paste(picture.convert("RGB"), (x, y))
        (integrator,) = SceneFile(HERE / name / "scene.xml").top_level("integrator")
        prompt = integrator.properties["prompt"]
        while draw.textlength(prompt, font=small) > TILE:
            prompt = prompt.rstrip(".").rsplit(" ", 1)[0] + "..."
        draw.text((x + 2, y + TILE + 3), name, fill=(30, 30, 34), font=font)
        draw.text((x + 2, y + TILE + 21), prompt, fill=(90, 90, 96), font=small)
    sheet.save(HERE / "scenes.jpg", quality=88, optimize=True)


if __name__ == "__main__":
    main()
