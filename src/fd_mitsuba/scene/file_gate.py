"""The one gate for files that Mitsuba is going to open: kind of file, size, announced contents, indices, numbers.

Mitsuba's readers wait for ever at a named pipe, take 6 GB for a picture of 200 kB, and follow an index that is out of
range. So nothing is instantiated before every file that a scene names came through here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS
from fd_mitsuba.io.picture_size import picture_size
from fd_mitsuba.io.regular_file import NotReadable, refuse_unreadable
from fd_mitsuba.scene.file_headers import HEADERS, BrokenHeader
from fd_mitsuba.scene.mesh_source import FILE_SHAPES, BrokenMesh, NotAMesh, shape_triangles
from fd_mitsuba.scene.plugins import FOCAL_REGION

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

MAX_BYTES = 1 << 33
"""Of any file that a scene names."""
MAX_PIXELS = 1 << 27
"""Of a picture: 16384 x 8192, which Mitsuba holds in 1.6 GB, and twice that while it reads it."""

_PICTURES = ("bitmap", "envmap")
_NEED_FILE = (
    *_PICTURES, *FILE_SHAPES.values(), "gridvolume", "sdfgrid", "measured", "measured_polarized", "bsplinecurve",
    "linearcurve", "ellipsoids", "ellipsoidsmesh",
)  # fmt: skip
_ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")
_CONDUCTORS = ("conductor", "roughconductor")

_sound_meshes: set[tuple[object, ...]] = set()


def refuse_incomplete(elements: Sequence[SceneElement]) -> None:
    """Raise UserError for an element without what Mitsuba takes for granted, and crashes where it is not there.

    Likewise for a second one of what there can be only one of, where Mitsuba does not say which.
    """
    environments = [element for element in elements if element.kind == "emitter" and element.plugin in _ENVIRONMENTS]
    if len(environments) > 1:
        raise environments[1].error("is a second environment; keep one")
    for element in elements:
        if element.plugin in _NEED_FILE and not element.properties.get("filename"):
            raise element.error('has no filename; write <string name="filename" value="..."/>')
        if element.plugin == "blendbsdf":
            children = [elements[position].kind for position in element.children.values()]
            if children.count("bsdf") != 2 or not ("weight" in element.properties or "weight" in element.children):
                raise element.error("needs two BSDFs and a weight; add what is missing")


def opened_files(
    elements: Sequence[SceneElement], resolver: Any, folder: Path, copied: Mapping[str, Path]
) -> dict[str, Path]:
    """Every file that the elements name, as `resolver` finds it: name -> file.

    Args:
        resolver: Mitsuba's, as it is while the scene is loaded.
        folder: where names were looked for, for messages.
        copied: names that a copied scene keeps in another place; see `scene_copy.copied_files`.

    Raises:
        UserError: a file that is missing, no regular file, too large, of too many pixels, or whose header announces
            more than it holds.
    """
    files: dict[str, Path] = {}
    for element in elements:
        for name in _names(element):
            target = copied.get(name) or Path(str(resolver.resolve(name)))
            stock = name.startswith("data/ior/")
            if stock and not target.is_file() and not target.exists():
                continue  # Mitsuba says which metals it knows
            try:
                refuse_unreadable(target, MAX_BYTES)
            except NotReadable as error:
                problem = f"not found (looked in {folder})" if str(error) == "not found" else error
                raise element.error(f"file {name!r} {problem}; correct the file name") from None
            if not stock:
                _check_content(element, name, target)
                files[name] = target
            elif target.resolve().is_relative_to(folder.resolve()):
                files[name] = target
    return files


def check_meshes(file: SceneFile) -> None:
    """Read the mesh of every shape, lamps and those within other shapes included, before Mitsuba uses any.

    A file that was found sound is not read again while it stays as it is.

    Raises:
        UserError: a mesh that cannot be read, without faces, with an index out of range or a number that is not finite.
    """
    for element in file.elements:
        if (
            element.kind == "shape"
            and element.plugin in FILE_SHAPES.values()
            and _key(file, element) not in _sound_meshes
        ):
            name = element.properties["filename"]
            plain = {key: value for key, value in element.properties.items() if key != "to_world"}
            plain["filename"] = str(file.resolve(name))
            try:
                shape_triangles(file.mi, element.plugin, plain, np.eye(4))
            except (BrokenMesh, NotAMesh) as error:
                raise element.error(f"{name}: {error}; repair the mesh and save it anew") from None
            except MITSUBA_ERRORS as error:
                problem = str(file.translated(error)).removeprefix(f"{file.path}: ")
                raise element.error(f"{name}: {problem}") from None
            mark_sound(file, element)


def mark_sound(file: SceneFile, element: SceneElement) -> None:
    """Remember that the mesh of an element was read and is sound."""
    _sound_meshes.add(_key(file, element))


def _key(file: SceneFile, element: SceneElement) -> tuple[object, ...]:
    path = file.resolve(element.properties["filename"])
    status = path.stat()
    which = element.properties.get("shape_index", 0)
    return str(path.resolve()), element.plugin, which, status.st_ino, status.st_size, status.st_mtime_ns


def _names(element: SceneElement) -> list[str]:
    names = [element.properties[key] for key in ("filename",) if element.properties.get(key)]
    if element.plugin in _CONDUCTORS and "eta" not in element.properties and "eta" not in element.children:
        metal = element.properties.get("material", "Cu")
        if not metal.replace("-", "").replace("_", "").isalnum():
            raise element.error(f"material {metal!r} is not a name; write one such as Au, or none")
        names += [f"data/ior/{metal}.{part}.spd" for part in ("eta", "k") if metal != "none"]
    return names


def _check_content(element: SceneElement, name: str, path: Path) -> None:
    try:
        if element.plugin in _PICTURES:
            width, height = picture_size(path) or (1, 1)  # whatever else it is, Mitsuba says
            if min(width, height) < 1:
                raise BrokenHeader("its header does not say how large the picture is")
            if width * height > MAX_PIXELS:
                limit = f"{MAX_PIXELS // 1_000_000} million"
                raise element.error(f"{name} has {width} x {height} pixels, more than {limit}; shrink it")
            return
        # A focal region goes by the suffix.
        plugin = FILE_SHAPES.get(path.suffix.lower(), "") if element.plugin == FOCAL_REGION else element.plugin
        if plugin in HEADERS:
            index = element.properties.get("shape_index", 0)
            HEADERS[plugin](path, index if isinstance(index, int) else 0)
    except BrokenHeader as error:
        raise element.error(f"{name}: {error}; write the file anew") from None
    except OSError as error:
        raise element.error(f"file {name!r} cannot be read ({error.strerror}); correct the file name") from None
