"""Numbers of a scene that are NaN or infinite: in its file, and in all that Mitsuba made of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.errors import UserError

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneFile

_PICTURES = ("data",)
"""Parameters that hold pictures: `appearance_inputs` names the file, and a shape can be grown without them."""


def refuse_broken_properties(file: SceneFile) -> None:
    """UserError for the first property of the scene file that holds NaN or infinity, with its element and line."""
    for element in file.elements:
        for name, value in element.properties.items():
            if not _finite(value):
                raise element.error(f"{name} holds NaN or infinity; correct its numbers")


def refuse_broken_parameters(file: SceneFile, loaded: Any) -> None:
    """UserError for what a loaded scene holds that is NaN or infinite: meshes, spectra, transforms, materials.

    Everything that Mitsuba lets be traversed is looked at, whatever its name.
    """
    key = _broken_parameter(file.mi, loaded)
    if key is None:
        return
    name, _, rest = key.partition(".")
    element = next((element for element in file.elements if element.id == name), None)
    elements, shapes = file.top_level("shape"), loaded.shapes()
    if element is None and len(elements) == len(shapes):  # without an id they are called by their address
        broken = ((item, _broken_parameter(file.mi, shape)) for item, shape in zip(elements, shapes, strict=True))
        element, rest = next(((item, key) for item, key in broken if key is not None), (None, rest))
    if element is None:
        raise UserError(f"{file.path}: {rest or name} of one of its objects holds NaN or infinity; correct its numbers")
    source = element.properties.get("filename")
    where = f"{source}: " if isinstance(source, str) else ""
    raise element.error(f"{where}{rest or name} holds NaN or infinity; correct its numbers")


def _broken_parameter(mi: Any, loaded: Any) -> str | None:
    try:
        found = list(mi.traverse(loaded).items())
    except TypeError:  # some plugins of Mitsuba, such as `hair`, offer parameters that cannot be read
        return None
    return next(
        (str(key) for key, value in found if key.rpartition(".")[2] not in _PICTURES and not _finite(value)), None
    )


def _finite(value: Any) -> bool:
    if isinstance(value, bool | str | int):
        return True
    return all(bool(np.isfinite(numbers).all()) for numbers in _numbers(value))


def _numbers(value: Any) -> Iterator[np.ndarray]:
    """The numbers of a value: a float, an array, a colour, a transform, the samples of a spectrum."""
    # Not asked by attribute: an array takes "matrix" for a choice of its components.
    kind = type(value).__name__
    parts = [value.matrix] if "Transform" in kind else [value]
    parts = [value.values, value.wavelengths] if kind == "Spectrum" and hasattr(value, "is_uniform") else parts
    for part in parts:
        try:
            numbers = np.array(part)
        except (TypeError, ValueError, RuntimeError):
            continue
        if numbers.dtype.kind == "f":
            yield numbers
