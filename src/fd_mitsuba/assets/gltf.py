"""glTF 2 and GLB: the meshes of the scene where their nodes put them, skinned ones in their rest pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMaterial, AssetMesh
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.gltf_file import GltfFile
from fd_mitsuba.assets.gltf_material import gltf_material

_DEEPEST = 200
_MOST_NODES = 100_000
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_SETS = 8


def read_gltf(path: Path) -> Asset:
    """The default scene of a `.glb` or `.gltf`.

    Raises:
        BrokenAsset: damaged, empty, compressed, too many faces.
    """
    return _Reader(GltfFile(path)).asset()


class _Reader:
    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self.notes: list[str] = []
        self.meshes: list[AssetMesh] = []
        self.materials: dict[int, int] = {}
        self.found: list[AssetMaterial] = []
        self.not_solid = 0
        self.faces = 0
        self.places: dict[int, np.ndarray] = {}

    def asset(self) -> Asset:
        file = self.file
        nodes = self._ordered()
        for index, place in nodes:
            node = file.item("nodes", index)
            if "mesh" in node:
                self._add(node, index, place)
        if not self.meshes:
            what = "holds only points or lines" if self.not_solid else "is empty: its scene has no mesh"
            raise BrokenAsset(f"{what}; export a surface of triangles")
        if self.not_solid:
            self.notes.append(f"{self.not_solid} primitives of points or lines are left out")
        if file.items("animations"):
            self.notes.append("is animated, and is taken in its rest pose")
        return Asset(tuple(self.meshes), tuple(self.found), "+y", "+z", "m", True, tuple(dict.fromkeys(self.notes)))

    def _ordered(self) -> list[tuple[int, np.ndarray]]:
        """The nodes of the default scene, each with its place."""
        file, nodes = self.file, self.file.items("nodes")
        scenes = file.items("scenes")
        if scenes:
            roots = file.item("scenes", file.content.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in nodes if isinstance(node, dict) for child in _list(node, "children")}
            roots = [index for index in range(len(nodes)) if index not in children]
        order: list[tuple[int, np.ndarray]] = []
        waiting = [(index, np.eye(4), 0) for index in reversed(roots if isinstance(roots, list) else [])]
        while waiting:
            index, above, depth = waiting.pop()
            node = file.item("nodes", index)
            if depth > _DEEPEST or len(order) > _MOST_NODES:
                raise BrokenAsset("its nodes go in a circle, or are too many; export the model anew")
            place = above @ _local(node)
            self.places[index] = place
            order.append((index, place))
            waiting += [(child, place, depth + 1) for child in reversed(_list(node, "children"))]
        return order

    def _add(self, node: dict[str, Any], index: int, place: np.ndarray) -> None:
        mesh = self.file.item("meshes", node["mesh"])
        name = str(node.get("name") or mesh.get("name") or f"node_{index}")
        weights = node.get("weights", mesh.get("weights", []))
        for primitive in _list(mesh, "primitives"):
            if not isinstance(primitive, dict):
                raise BrokenAsset(f"mesh {name!r} is not as glTF has it; export the model anew")
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                self.not_solid += 1
                continue
            self._add_primitive(name, primitive, mode, weights, node, place)

    def _add_primitive(
        self, name: str, primitive: dict[str, Any], mode: int, weights: Any, node: dict[str, Any], place: np.ndarray
    ) -> None:
        file, attributes = self.file, primitive.get("attributes")
        if not isinstance(attributes, dict) or "POSITION" not in attributes:
            return
        vertices = self._vectors(attributes["POSITION"], 3, name)
        if "indices" in primitive:
            indices = file.array(primitive["indices"])[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(vertices))
        faces = _triangles(indices, mode)
        if not len(faces):
            return
        if faces.max() >= len(vertices):
            raise BrokenAsset(f"mesh {name!r} has a vertex index out of range; export the model anew")
        self.faces += len(faces)
        if self.faces > MOST_FACES:
            raise BrokenAsset(f"has more than {MOST_FACES // 1_000_000} million faces; decimate it to a tenth")
        normals = self._vectors(attributes["NORMAL"], 3, name) if "NORMAL" in attributes else None
        vertices = self._morphed(vertices, primitive, weights, name)
        if "skin" in node and "JOINTS_0" in attributes:
            vertices, normals = self._skinned(vertices, normals, attributes, node["skin"], name)
            place = np.eye(4)  # that of the node does not count
        uvs = {
            number: self._vectors(attributes[f"TEXCOORD_{number}"], 2, name)
            for number in range(_SETS)
            if f"TEXCOORD_{number}" in attributes
        }
        rows = [vertices, *([] if normals is None else [normals]), *uvs.values()]
        colours = None
        if "COLOR_0" in attributes:
            colours = np.clip(file.array(attributes["COLOR_0"])[:, :3], 0.0, 1.0)
            rows.append(colours)
        if any(len(values) != len(vertices) for values in rows):
            raise BrokenAsset(f"mesh {name!r} has attributes of different lengths; export the model anew")
        material = self._material(primitive.get("material"))
        self.meshes.append(AssetMesh(name, vertices, faces, material, normals, uvs, colours, place))

    def _vectors(self, accessor: object, width: int, name: str) -> np.ndarray:
        values = self.file.array(accessor).astype(np.float64)
        if values.shape[1] != width:
            raise BrokenAsset(f"mesh {name!r} has an attribute of {values.shape[1]} numbers, not {width}; export anew")
        return values

    def _material(self, index: object) -> int:
        if index is None:
            return -1
        self.file.item("materials", index)
        assert isinstance(index, int)
        if index not in self.materials:
            self.materials[index] = len(self.found)
            self.found.append(gltf_material(self.file, index, self.notes))
        return self.materials[index]

    def _morphed(self, vertices: np.ndarray, primitive: dict[str, Any], weights: Any, name: str) -> np.ndarray:
        for target, weight in zip(
            _list(primitive, "targets"), weights if isinstance(weights, list) else [], strict=False
        ):
            if isinstance(target, dict) and "POSITION" in target and isinstance(weight, (int, float)) and weight:
                shift = self._vectors(target["POSITION"], 3, name)
                if shift.shape == vertices.shape:
                    vertices = vertices + weight * shift
                    self.notes.append(f"mesh {name!r} has shape keys, and is taken with those that the file sets")
        return vertices

    def _skinned(
        self, vertices: np.ndarray, normals: np.ndarray | None, attributes: dict[str, Any], skin: object, name: str
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Where the joints as the file has them put the vertices, in the asset's frame."""
        entry = self.file.item("skins", skin)
        joints = _list(entry, "joints")
        if not joints or any(joint not in self.places for joint in joints):
            raise BrokenAsset(f"mesh {name!r} has a skin whose joints are not in the scene; export the model anew")
        matrices = np.stack([self.places[joint] for joint in joints])
        if "inverseBindMatrices" in entry:
            inverse = self.file.array(entry["inverseBindMatrices"])
            if inverse.shape != (len(joints), 16):
                raise BrokenAsset(f"mesh {name!r} has a skin with too few matrices; export the model anew")
            matrices = matrices @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        blended, total = np.zeros((len(vertices), 4, 4)), np.zeros(len(vertices))
        for number in range(_SETS):
            if f"JOINTS_{number}" not in attributes or f"WEIGHTS_{number}" not in attributes:
                break
            chosen = self.file.array(attributes[f"JOINTS_{number}"]).astype(np.int64)
            weights = self.file.array(attributes[f"WEIGHTS_{number}"]).astype(np.float64)
            if chosen.shape != weights.shape or len(chosen) != len(vertices) or chosen.max(initial=0) >= len(joints):
                raise BrokenAsset(f"mesh {name!r} has a skin that does not fit it; export the model anew")
            for column in range(chosen.shape[1]):
                blended += weights[:, column, None, None] * matrices[chosen[:, column]]
                total += weights[:, column]
        blended[total <= 0], total[total <= 0] = np.eye(4), 1.0
        blended /= total[:, None, None]
        self.notes.append(f"mesh {name!r} is skinned, and is taken in its rest pose")
        moved = np.einsum("nij,nj->ni", blended[:, :3, :3], vertices) + blended[:, :3, 3]
        if normals is not None:
            turned = np.einsum("nij,nj->ni", blended[:, :3, :3], normals)
            normals = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
        return moved, normals


def _local(node: dict[str, Any]) -> np.ndarray:
    def numbers(key: str, default: list[float]) -> np.ndarray:
        given = node.get(key, default)
        try:
            found = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            found = np.zeros(0)
        if found.shape != (len(default),) or not np.isfinite(found).all():
            raise BrokenAsset(f"a node's {key} is not as glTF has it; export the model anew")
        return found

    if "matrix" in node:
        return numbers("matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T
    x, y, z, w = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    norm = x * x + y * y + z * z + w * w
    s = 2.0 / norm if norm > 0 else 0.0
    turn = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * numbers("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = numbers("translation", [0.0, 0.0, 0.0])
    return matrix


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == _FAN:
        return np.stack([np.broadcast_to(indices[0], len(indices) - 2), indices[1:-1], indices[2:]], axis=1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _list(parent: dict[str, Any], key: str) -> list[Any]:
    found = parent.get(key, [])
    return found if isinstance(found, list) else []
