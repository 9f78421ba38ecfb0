"""glTF 2.0 in one binary file (GLB): named nodes, each with its own mesh and material."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pygltflib as gltf

from fd_mitsuba.export.export_mesh import ExportMesh
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.export.pictures import Picture

ROOT_NAME = "asset"
"""Of the node above all others, in files whose unit is known."""
_WRAP = {"repeat": gltf.REPEAT, "mirror": gltf.MIRRORED_REPEAT, "clamp": gltf.CLAMP_TO_EDGE}
_COMPONENT = {"f4": gltf.FLOAT, "u4": gltf.UNSIGNED_INT, "u2": gltf.UNSIGNED_SHORT}
_SHAPE = {1: gltf.SCALAR, 2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4}


@dataclass(frozen=True)
class GltfMesh(ExportMesh):
    """A node with one mesh; everything is written as float32, and UVs with the origin top left.

    Attributes:
        tangents: (V, 4); only written with a normal map.
        to_world: (4, 4), the node's place.
        parent: name of an empty node to hang it below, "" for the top.
        extras: what else to say about the node.
        Others: see `ExportMesh`.
    """

    tangents: np.ndarray | None = None
    to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    parent: str = ""
    extras: dict[str, Any] = field(default_factory=dict)


def glb_bytes(meshes: list[GltfMesh], extras: dict[str, Any], metres: float | None = None) -> bytes:
    """A GLB of the meshes, in their order; `extras` goes to the scene.

    Args:
        metres: how many a unit of the meshes is: all nodes then hang below one node `ROOT_NAME` with that scale.
    """
    writer = _Writer()
    children: dict[str, list[int]] = {}
    roots: list[int] = []
    for mesh in meshes:
        node = writer.node(mesh)
        if not mesh.parent:
            roots.append(node)
            continue
        if mesh.parent not in children:
            children[mesh.parent] = []
            roots.append(writer.append("nodes", gltf.Node(name=mesh.parent, children=children[mesh.parent])))
        children[mesh.parent].append(node)
    if metres is not None:
        root = gltf.Node(name=ROOT_NAME, children=roots)
        if metres != 1:
            root.scale = [metres] * 3
        roots = [writer.append("nodes", root)]
    return writer.finish(roots, extras)


def is_placement(matrix: np.ndarray) -> bool:
    """Whether a node can have this (4, 4) matrix: turned, scaled along its own axes and moved, but not sheared."""
    linear = np.asarray(matrix)[:3, :3]
    product = linear.T @ linear
    return bool(np.allclose(product, np.diag(np.diag(product)), atol=1e-7 * np.trace(product)))


class _Writer:
    def __init__(self) -> None:
        self.file = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="fd_mitsuba"))
        self.blob = bytearray()
        self._textures: dict[tuple[bytes, str, bool], int] = {}

    def append(self, kind: str, item: Any) -> int:
        """Add an item to one of the file's lists; returns its number."""
        items = getattr(self.file, kind)
        items.append(item)
        return len(items) - 1

    def node(self, mesh: GltfMesh) -> int:
        """The node of a mesh with everything below it."""
        attributes = gltf.Attributes(POSITION=self._accessor(mesh.vertices, bounds=True))
        if mesh.normals is not None:
            attributes.NORMAL = self._accessor(mesh.normals)
        if mesh.tangents is not None and mesh.material.normal_picture is not None:
            attributes.TANGENT = self._accessor(mesh.tangents)
        if mesh.uv is not None:
            attributes.TEXCOORD_0 = self._accessor(mesh.uv)
        if mesh.colours is not None:
            attributes.COLOR_0 = self._accessor(mesh.colours)
        primitive = gltf.Primitive(
            attributes=attributes,
            indices=self._indices(mesh.faces, len(mesh.vertices)),
            material=self._material(mesh.material),
            mode=gltf.TRIANGLES,
        )
        number = self.append("meshes", gltf.Mesh(name=mesh.name, primitives=[primitive]))
        node = gltf.Node(name=mesh.name, mesh=number, extras=mesh.extras)
        if not np.array_equal(mesh.to_world, np.eye(4)):
            node.matrix = [float(value) for value in np.asarray(mesh.to_world, dtype=np.float64).T.ravel()]
        return self.append("nodes", node)

    def finish(self, roots: list[int], extras: dict[str, Any]) -> bytes:
        """The file's bytes."""
        self.file.scenes = [gltf.Scene(nodes=roots, extras=extras)]
        self.file.scene = 0
        self.file.buffers = [gltf.Buffer(byteLength=len(self.blob))]
        self.file.set_binary_blob(bytes(self.blob))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return b"".join(self.file.save_to_bytes())

    def _view(self, data: bytes, target: int | None) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = gltf.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target)
        self.blob += data
        return self.append("bufferViews", view)

    def _accessor(self, values: np.ndarray, bounds: bool = False) -> int:
        array = np.ascontiguousarray(values, dtype="<f4")
        accessor = gltf.Accessor(
            bufferView=self._view(array.tobytes(), gltf.ARRAY_BUFFER),
            componentType=gltf.FLOAT,
            count=len(array),
            type=_SHAPE[array.shape[1]],
        )
        if bounds:
            accessor.min = [float(value) for value in array.min(axis=0)]
            accessor.max = [float(value) for value in array.max(axis=0)]
        return self.append("accessors", accessor)

    def _indices(self, faces: np.ndarray, count: int) -> int:
        kind = "u2" if count < 65535 else "u4"  # the largest number is not an index
        array = np.ascontiguousarray(faces.ravel(), dtype=f"<{kind}")
        view = self._view(array.tobytes(), gltf.ELEMENT_ARRAY_BUFFER)
        accessor = gltf.Accessor(bufferView=view, componentType=_COMPONENT[kind], count=array.size, type=gltf.SCALAR)
        return self.append("accessors", accessor)

    def _material(self, material: PbrMaterial) -> int:
        packed = material.orm_picture is not None
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=[*material.base_color, material.opacity],
            roughnessFactor=1.0 if packed else material.roughness,
            metallicFactor=1.0 if packed else material.metallic,
        )
        if material.base_picture is not None:
            surface.baseColorTexture = gltf.TextureInfo(**self._texture(material.base_picture))
        if material.orm_picture is not None:
            surface.metallicRoughnessTexture = gltf.TextureInfo(**self._texture(material.orm_picture))
        made = gltf.Material(
            name=material.name,
            pbrMetallicRoughness=surface,
            doubleSided=material.double_sided,
            alphaMode=material.alpha_mode,
            alphaCutoff=None,
            extensions=self._extensions(material),
            extras={"notes": list(material.notes)} if material.notes else {},
        )
        if material.normal_picture is not None:
            made.normalTexture = gltf.NormalMaterialTexture(**self._texture(material.normal_picture))
        return self.append("materials", made)

    def _extensions(self, material: PbrMaterial) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if abs(material.ior - 1.5) > 1e-3:
            found["KHR_materials_ior"] = {"ior": material.ior}
        if material.specular != 1.0:
            found["KHR_materials_specular"] = {"specularFactor": material.specular}
        if material.transmission > 0:
            found["KHR_materials_transmission"] = {"transmissionFactor": material.transmission}
        if material.clearcoat > 0:
            found["KHR_materials_clearcoat"] = {
                "clearcoatFactor": material.clearcoat,
                "clearcoatRoughnessFactor": material.clearcoat_roughness,
            }
        self._uses(found)
        return found

    def _uses(self, names: Any) -> None:
        used = self.file.extensionsUsed
        used += [name for name in names if name not in used]

    def _texture(self, picture: Picture) -> dict[str, Any]:
        key = (picture.data, picture.wrap, picture.nearest)
        if key not in self._textures:
            view = self._view(picture.data, None)
            image = self.append("images", gltf.Image(name=picture.name, mimeType=picture.mime, bufferView=view))
            wrap = _WRAP.get(picture.wrap, gltf.REPEAT)
            minified = gltf.NEAREST if picture.nearest else gltf.LINEAR_MIPMAP_LINEAR
            magnified = gltf.NEAREST if picture.nearest else gltf.LINEAR
            sampler = gltf.Sampler(wrapS=wrap, wrapT=wrap, minFilter=minified, magFilter=magnified)
            place = self.append("samplers", sampler)
            self._textures[key] = self.append("textures", gltf.Texture(source=image, sampler=place))
        info: dict[str, Any] = {"index": self._textures[key], "texCoord": 0}
        if picture.tiling != ((0.0, 0.0), (1.0, 1.0)) or picture.rotation:
            offset, scale = picture.tiling
            turned = {"rotation": picture.rotation} if picture.rotation else {}
            transform = {"offset": list(offset), **turned, "scale": list(scale)}
            info["extensions"] = {"KHR_texture_transform": transform}
            self._uses(info["extensions"])
        return info
