"""The photographs of a run: of the whole object, before and after, of the part from close by, and all around."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from fd_mitsuba.config.sections import OutputConfig
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.io.ply import read_ply
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.region_mode import cut_faces_name
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.denoising import NO_DENOISER, has_denoiser
from fd_mitsuba.viewing.framed_camera import framed_camera, turned_cameras
from fd_mitsuba.viewing.photo_set import PhotoSet, vertex_positions
from fd_mitsuba.viewing.sheets import as_bytes
from fd_mitsuba.viewing.turntable import write_video

_FOV_DEG = 25.0
_ELEVATION_DEG = 16.0
"""More than half the field of view: so all that is behind the object is ground."""
_AZIMUTHS_DEG = (30.0, -30.0, 150.0, 210.0)
_CLEARLY_MORE = 1.5
"""How many times as much of the part another side must show to be taken in place of the first."""
_GROWN = ("part_", "cut_face_")
_SPP, _TURN_SPP = 4, 1
_TURN_SIZE = 400
_FILL, _CLOSE_FILL, _TURN_FILL = 0.82, 0.72, 0.92
_SCAR_FILL = 0.3
"""Of a photograph of where something was taken off: with what is around it."""


def write_photographs(
    scene: EditScene, folder: Path, output: OutputConfig, say: Callable[[str], None] = lambda line: None
) -> None:
    """Photograph what the folder's `export/mitsuba/scene.xml` shows, under its own light.

    Writes `beauty.png`, `beauty_base.png`, `closeup.png` and `appearance.png`, which shows all of them, to `images/`,
    and `appearance.mp4` to `videos/`.

    Args:
        scene: what was edited: its base is the object before.
        say: hears where there is no denoiser.
    """
    if not has_denoiser():
        say(NO_DENOISER)
    size, turn_size = output.picture_size, min(output.picture_size, _TURN_SIZE)
    views = PhotoViews.of(scene, folder, turn_size)
    frames = [
        views.shown(views.after.photograph(camera, turn_size, _TURN_SPP, seed=2))
        for camera in views.around(output.turntable_frames)
    ]
    images = {
        "beauty_base": views.shown(views.before.photograph(views.camera, size, _SPP // 2)),
        "beauty": views.shown(views.after.photograph(views.camera, size, _SPP)),
        "closeup": views.shown(views.after.photograph(views.close, size, _SPP, seed=1)),
    }
    for name, image in images.items():
        write_picture(folder / "images" / f"{name}.png", Image.fromarray(image))
    write_picture(folder / "images" / "appearance.png", _sheet(images, frames))
    write_video(np.stack(frames), folder / "videos" / "appearance.mp4")


@dataclass(frozen=True)
class PhotoViews:
    """Where a run's object is photographed from, and how long each photograph is exposed.

    Attributes:
        after, before: the object with and without its new parts.
        camera: sees all of it, from a side that shows the parts.
        close: sees the parts from close by.
        exposure: (3,) what to multiply linear RGB with.
        whole: (N, 3) points of the object, canonical frame.
    """

    after: PhotoSet
    before: PhotoSet
    camera: CameraBatch
    close: CameraBatch
    exposure: np.ndarray
    whole: np.ndarray

    @classmethod
    def of(cls, scene: EditScene, folder: Path, size: int = _TURN_SIZE) -> PhotoViews:
        """Those of a run folder whose Mitsuba scene has been exported; `size` is what `exposure` is found at."""
        away, frame, base = ("focal_region", "sensor", "integrator"), scene.render_frame, scene.base_canonical.vertices
        exported = SceneFile(folder / "export" / "mitsuba" / "scene.xml")
        shown = [shape for shape in exported.top_level("shape") if shape.id not in scene.surroundings_ids]
        loaded = exported.instantiate(without=away, origin=scene.origin, shapes=shown)
        old = {part.shape for part in scene.earlier}
        grown = [shape for shape in loaded.shapes() if shape.id().startswith(_GROWN) and shape.id() not in old]
        names = [shape.id() for shape in grown]
        corners = [frame.to_canonical(vertex_positions(exported.mi, shape)) for shape in grown]
        whole = np.concatenate([base, *corners])
        cut = _cut_faces(scene, folder) if scene.subtracts and not grown else None
        parts = np.concatenate(corners) if corners else base if cut is None else cut.reshape(-1, 3)
        ground = float(whole[:, 1].min())
        after = PhotoSet.of(exported.mi, loaded, frame, ground)
        without = scene.mitsuba_scene(without=away)
        before = PhotoSet.of(exported.mi, without, frame, ground)

        def shows(camera: CameraBatch) -> float:
            return after.share_seen(camera, names) if cut is None else _turned_to(cut, camera)

        camera = _from_best_side(shows, whole, _FILL)
        close = _from_best_side(shows, parts, _SCAR_FILL if scene.subtracts else _CLOSE_FILL)
        return cls(after, before, camera, close, after.exposure(camera, size), whole)

    def around(self, count: int) -> list[CameraBatch]:
        """`count` cameras around the object."""
        return turned_cameras(self.whole, count, _ELEVATION_DEG, _FOV_DEG, _TURN_FILL)

    def shown(self, linear: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 sRGB of linear radiance."""
        return as_bytes(to_srgb(torch.from_numpy(linear * self.exposure).permute(2, 0, 1)[None]))[0]


def _cut_faces(scene: EditScene, folder: Path) -> np.ndarray | None:
    """Corners (F, 3, 3) of what cuts have laid bare, canonical frame; None where that is nothing."""
    paths = [folder / "export" / f"{cut_faces_name(name)}.ply" for name in scene.parts]
    meshes = [read_ply(path) for path in paths if path.is_file()]
    corners = [scene.frame.to_canonical(vertices)[faces] for vertices, faces in meshes]
    return np.concatenate(corners) if corners else None


def _turned_to(corners: np.ndarray, camera: CameraBatch) -> float:
    """How large triangles (F, 3, 3) appear that look to the camera, as if nothing stood before them."""
    towards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ camera.basis()[2][0]
    return float(towards.clip(min=0).sum())


def _from_best_side(shows: Callable[[CameraBatch], float], points: np.ndarray, fill: float) -> CameraBatch:
    """From the front right, unless another side shows clearly more."""
    cameras = [framed_camera(points, azimuth, _ELEVATION_DEG, _FOV_DEG, fill) for azimuth in _AZIMUTHS_DEG]
    shares = [shows(camera) for camera in cameras]
    most = int(np.argmax(shares))
    return cameras[most if shares[most] > _CLEARLY_MORE * shares[0] else 0]


def _sheet(images: dict[str, np.ndarray], frames: list[np.ndarray]) -> Image.Image:
    """Before and after, and below them the part and four frames of the turntable."""
    side = images["beauty"].shape[0] * 3 // 4 // 2 * 2
    sheet = Image.new("RGB", (2 * side, 2 * side))
    for number, name in enumerate(("beauty_base", "beauty", "closeup")):
        tile = Image.fromarray(images[name]).resize((side, side), Image.Resampling.LANCZOS)
        sheet.paste(tile, (number % 2 * side, number // 2 * side))
    for number in range(4):
        frame = Image.fromarray(frames[number * len(frames) // 4])
        tile = frame.resize((side // 2, side // 2), Image.Resampling.LANCZOS)
        sheet.paste(tile, (side + number % 2 * side // 2, side + number // 2 * side // 2))
    return sheet
