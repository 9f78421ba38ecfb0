"""An exported part in many places, as GLB: nodes that share one mesh, where `instances` has a shape group."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import pygltflib as gltf

from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.gltf import ROOT_NAME, is_placement


class Place(Protocol):
    """One copy: of which part, (4, 4) in the user's frame, and whether the base comes along."""

    @property
    def part(self) -> str: ...

    @property
    def to_world(self) -> np.ndarray: ...

    @property
    def base(self) -> bool: ...


def instance_glb(asset: bytes, placements: Sequence[Place]) -> bytes:
    """The exported GLB with its parts where the placements say, named `part_<name>_1`, `_2`, ...

    Meshes, materials and pictures are those of `asset`, each there once. What no placement names stays where it is.

    Args:
        asset: what `export.gltf` wrote.

    Raises:
        UserError: a part that the GLB does not have.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = gltf.GLTF2.load_from_bytes(asset)
    roots = file.scenes[0].nodes if file is not None else None
    assert file is not None and roots is not None  # `export.gltf` wrote it
    above = file.nodes[roots[0]] if len(roots) == 1 and file.nodes[roots[0]].name == ROOT_NAME else None
    sources = {file.nodes[number].name: number for number in (roots if above is None else above.children or [])}
    before, file.nodes = file.nodes, []
    wanted: dict[str, list[np.ndarray]] = {}
    for placement in placements:
        for name in [f"part_{placement.part}"] + [BASE_NAME] * placement.base:
            if name not in sources:
                raise UserError(f"{name!r} is not in the exported GLB; export the run anew")
            wanted.setdefault(name, []).append(placement.to_world)
    nodes = [_copied(file, before, number) for name, number in sources.items() if name not in wanted]
    for name, places in wanted.items():
        for count, place in enumerate(places, 1):
            nodes.append(_placed(file, before, sources[name], place, f"_{count}"))
    if above is not None:  # which turns the scene's unit into metres
        above.children, nodes = nodes, [len(file.nodes)]
        file.nodes.append(above)
    file.scenes[0].nodes = nodes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return b"".join(file.save_to_bytes())


def _placed(file: gltf.GLTF2, before: list[gltf.Node], number: int, place: np.ndarray, suffix: str) -> int:
    """A copy of a node and all below it, moved by `place`.

    A node may turn and scale along its own axes, but not shear. Any linear map is a turn, a scaling and another turn;
    where one node does not do, the last turn gets a node of its own, below the other two.
    """
    source = before[number]
    whole = place @ _matrix(source)
    if is_placement(whole) and not source.children:
        return _copied(file, before, number, whole, suffix)
    if is_placement(place):
        outer, inner = place, _matrix(source)
    else:
        first, stretch, second = np.linalg.svd(place[:3, :3])
        turned = np.linalg.det(second)
        outer, inner = np.eye(4), np.eye(4)
        outer[:3, :3], outer[:3, 3] = turned * first * stretch, place[:3, 3]
        inner[:3, :3] = turned * second
        inner = inner @ _matrix(source)
    below = _copied(file, before, number, inner, suffix)
    node = gltf.Node(name=f"place_of_{source.name}{suffix}", children=[below])
    node.matrix = _column_major(outer)
    file.nodes.append(node)
    return len(file.nodes) - 1


def _copied(
    file: gltf.GLTF2, before: list[gltf.Node], number: int, matrix: np.ndarray | None = None, suffix: str = ""
) -> int:
    node = copy.copy(before[number])
    node.name = f"{node.name}{suffix}"
    node.children = [_copied(file, before, child, None, suffix) for child in node.children or ()]
    if matrix is not None:
        node.matrix = None if np.array_equal(matrix, np.eye(4)) else _column_major(matrix)
    file.nodes.append(node)
    return len(file.nodes) - 1


def _matrix(node: gltf.Node) -> np.ndarray:
    if node.matrix is not None:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if node.translation is not None:
        matrix[:3, 3] = node.translation
    return matrix


def _column_major(matrix: np.ndarray) -> list[float]:
    return [float(value) for value in np.asarray(matrix, dtype=np.float64).T.ravel()]
