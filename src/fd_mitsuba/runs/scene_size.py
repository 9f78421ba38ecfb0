"""What of a scene costs memory and time: counted from the heads of its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from fd_mitsuba.io.picture_size import picture_size
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.ply_header import read_ply_header


@dataclass(frozen=True)
class SceneSize:
    """What of a scene costs memory.

    Attributes:
        faces: of the base.
        light_pixels: of all images that emitters show.
        texture_values: pixels times channels of all other images.
        faces_around: of all PLY and OBJ files that are not the base's: surroundings and lamps.
    """

    faces: int
    light_pixels: int = 0
    texture_values: int = 0
    faces_around: int = 0

    @classmethod
    def of(cls, scene: EditScene) -> SceneSize:
        """Read from the heads of the scene's files; an image that does not say its size counts as none."""
        file = scene.inputs.scene
        lights, textures, around = {}, {}, 0
        base_files = {path for mesh in scene.base for path in mesh.source_files}
        for element in file.elements:
            name = element.properties.get("filename")
            if not isinstance(name, str):
                continue
            path = file.resolve(name)
            if element.plugin in ("ply", "obj") and path not in base_files:
                around += _faces(path)
            elif element.plugin in ("envmap", "bitmap"):
                width, height = picture_size(path) or (0, 0)
                if element.plugin == "envmap":
                    lights[path] = width * height
                else:
                    textures[path] = width * height * _channels(path)
        faces = sum(len(mesh.faces) for mesh in scene.base)
        return cls(faces, sum(lights.values()), sum(textures.values()), around)


def _faces(path: Path) -> int:
    """Of a PLY by its header, of an OBJ by its lines."""
    if header := read_ply_header(path):
        return header.counts.get("face", 0)
    with path.open("rb") as lines:
        return sum(line.startswith(b"f ") for line in lines)


def _channels(path: Path) -> int:
    try:
        with Image.open(path) as image:
            return len(image.getbands())
    except Exception:  # formats that Pillow does not read, such as EXR
        return 3
