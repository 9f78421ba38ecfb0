"""The container of a glTF asset: its JSON, its buffers, the arrays and images in them; nothing is trusted."""

from __future__ import annotations

import base64
import binascii
import struct
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from fd_mitsuba.assets.asset import TextureImage
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.images import MOST_BYTES, beside, checked_image, read_image
from fd_mitsuba.io.json_object import parse_json_object
from fd_mitsuba.io.regular_file import NotReadable, read_regular

_MOST_BYTES = 1 << 32
_MOST_JSON = 1 << 27
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MOST_ROWS = 1 << 27
_COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
_UNREAD = {"KHR_texture_basisu": "Basis Universal textures", "EXT_mesh_gpu_instancing": "instancing on the GPU"}
_SERVED = (
    "KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_lights_punctual",
    "KHR_materials_unlit", "KHR_materials_ior", "KHR_materials_specular", "KHR_materials_transmission",
    "KHR_materials_clearcoat", "KHR_materials_pbrSpecularGlossiness", "KHR_materials_emissive_strength",
    "KHR_materials_volume", "KHR_materials_sheen", "KHR_materials_anisotropy", "KHR_materials_iridescence",
    "KHR_materials_dispersion", "KHR_materials_variants", "KHR_animation_pointer", "KHR_node_visibility",
)  # fmt: skip


class GltfFile:
    """A `.glb` or `.gltf` with all that it reads.

    Attributes:
        content: the JSON.

    Raises:
        BrokenAsset: not glTF 2, damaged, compressed in a way that is not read, or with files outside its folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            data = read_regular(path, _MOST_BYTES)
        except NotReadable as error:
            raise BrokenAsset(f"{error}") from None
        text, self._chunk = _chunks(data) if data.startswith(b"glTF") else (data, None)
        if len(text) > _MOST_JSON:
            raise BrokenAsset(f"its JSON has {len(text) >> 20} MB; that is no model")
        try:
            content = parse_json_object(text.decode("utf-8-sig"))
        except UnicodeDecodeError:
            content = None
        if content is None:
            raise BrokenAsset("is no glTF: its JSON cannot be read; export the model anew")
        self.content = content
        version = str(self.section("asset").get("version", ""))
        if not version.startswith("2."):
            raise BrokenAsset(f"is glTF {version[:10] or 'of no version'}; export the model as glTF 2.0")
        self._refuse_extensions()
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, TextureImage] = {}

    def section(self, name: str) -> dict[str, Any]:
        """An object of the JSON's top level; empty where it is not there."""
        found = self.content.get(name)
        return found if isinstance(found, dict) else {}

    def items(self, name: str) -> list[Any]:
        """A list of the JSON's top level; empty where it is not there."""
        found = self.content.get(name)
        return found if isinstance(found, list) else []

    def item(self, name: str, index: object) -> dict[str, Any]:
        """Entry `index` of a list of the top level; BrokenAsset where there is none."""
        found = self.items(name)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(found):
            raise BrokenAsset(f"names {name} {index!r}, and has {len(found)}; export the model anew")
        if not isinstance(found[index], dict):
            raise BrokenAsset(f"{name} {index} is not as glTF has it; export the model anew")
        return found[index]

    def array(self, index: object) -> np.ndarray:
        """(N, width) of an accessor: whole numbers as they are stored, normalised ones and floats as float64."""
        accessor = self.item("accessors", index)
        count, kind = accessor.get("count"), _TYPES.get(accessor.get("componentType", 0))
        width = _WIDTHS.get(str(accessor.get("type")))
        if kind is None or width is None or not _is_count(count) or count > _MOST_ROWS:
            raise BrokenAsset(f"accessor {index} is not as glTF has it; export the model anew")
        dtype = np.dtype(kind)
        if "bufferView" in accessor:
            values = self._rows(accessor["bufferView"], accessor.get("byteOffset", 0), count, width, dtype)
        elif "sparse" in accessor:
            values = np.zeros((count, width), dtype)
        else:
            raise BrokenAsset(f"accessor {index} has no data; export the model without compression")
        if isinstance(accessor.get("sparse"), dict):
            values = self._with_sparse(values, accessor["sparse"], width, dtype)
        if dtype.kind == "f":
            return values.astype(np.float64)
        if accessor.get("normalized"):
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def image(self, index: object) -> TextureImage:
        """An image: of a buffer, embedded in the JSON, or beside the asset.

        Raises:
            BrokenAsset: it is missing, no image, too large, or outside the asset's folder.
        """
        entry = self.item("images", index)
        assert isinstance(index, int)
        if index not in self._images:
            self._images[index] = self._load_image(entry, index)
        return self._images[index]

    def _load_image(self, entry: dict[str, Any], index: int) -> TextureImage:
        name = str(entry.get("name") or "")
        uri = entry.get("uri")
        if isinstance(uri, str) and uri.startswith("data:"):
            return checked_image(name or f"image_{index}", _embedded(uri))
        if isinstance(uri, str):
            return read_image(beside(self.path.parent, uri))
        return checked_image(name or f"image_{index}", bytes(self._view(entry.get("bufferView"))[0]))

    def _refuse_extensions(self) -> None:
        used = [str(name) for key in ("extensionsRequired", "extensionsUsed") for name in self.items(key)]
        for name in used:
            if name in _COMPRESSED:
                raise BrokenAsset(
                    f"is compressed by {_COMPRESSED[name]} ({name}), which is not read; export it without compression, "
                    "or run `gltf-transform copy` on it, which unpacks"
                )
        for name in map(str, self.items("extensionsRequired")):
            if name not in _SERVED:
                what = f" ({_UNREAD[name]})" if name in _UNREAD else ""
                raise BrokenAsset(f"needs the extension {name[:60]}{what}, which is not read; export it without")

    def _buffer(self, index: object) -> bytes:
        entry = self.item("buffers", index)
        assert isinstance(index, int)
        if index not in self._buffers:
            self._buffers[index] = self._load_buffer(entry)
        return self._buffers[index]

    def _load_buffer(self, entry: dict[str, Any]) -> bytes:
        uri = entry.get("uri")
        if isinstance(uri, str) and uri.startswith("data:"):
            return _embedded(uri)
        if isinstance(uri, str):
            try:
                return read_regular(beside(self.path.parent, uri), _MOST_BYTES)
            except NotReadable as error:
                raise BrokenAsset(f"its buffer {uri[:60]!r} {error}; keep the asset's files together") from None
        if self._chunk is None:
            raise BrokenAsset("has a buffer without data; export the model anew")
        return self._chunk

    def _view(self, index: object) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride, 0 where its rows are packed."""
        view = self.item("bufferViews", index)
        start, length, stride = view.get("byteOffset", 0), view.get("byteLength"), view.get("byteStride", 0)
        data = self._buffer(view.get("buffer"))
        if not (_is_count(start) and _is_count(length) and _is_count(stride)) or start + length > len(data):
            raise BrokenAsset(f"bufferView {index} does not lie within its buffer; export the model anew")
        return memoryview(data)[start : start + length], stride

    def _rows(self, view: object, offset: object, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        data, stride = self._view(view)
        row = width * dtype.itemsize
        stride = stride or row
        if not _is_count(offset) or stride < row or (count and offset + (count - 1) * stride + row > len(data)):
            raise BrokenAsset(f"bufferView {view} holds less than its accessors need; export the model anew")
        return (
            np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)) if count else np.zeros((0, width))
        )

    def _with_sparse(self, values: np.ndarray, sparse: dict[str, Any], width: int, dtype: np.dtype) -> np.ndarray:
        count, indices, changed = sparse.get("count"), sparse.get("indices"), sparse.get("values")
        indices = indices if isinstance(indices, dict) else {}
        kind = _TYPES.get(indices.get("componentType", 0))
        if kind is None or not isinstance(changed, dict) or not _is_count(count) or count > len(values):
            raise BrokenAsset("has a sparse accessor that is not as glTF has it; export the model anew")
        place = self._rows(indices.get("bufferView"), indices.get("byteOffset", 0), count, 1, np.dtype(kind))[:, 0]
        rows = self._rows(changed.get("bufferView"), changed.get("byteOffset", 0), count, width, dtype)
        if len(place) and (place.min() < 0 or place.max() >= len(values)):
            raise BrokenAsset("has a sparse accessor with an index out of range; export the model anew")
        values = values.copy()
        values[place.astype(np.int64)] = rows
        return values


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB."""
    try:
        _, version, length = struct.unpack_from("<4sII", data)
        if version != 2:
            raise BrokenAsset(f"is a GLB of version {version}; export the model as glTF 2.0")
        place, found = 12, {}
        while place + 8 <= min(len(data), length):
            size, kind = struct.unpack_from("<II", data, place)
            if place + 8 + size > len(data):
                raise BrokenAsset("is cut short; copy or export it anew")
            found.setdefault(kind, data[place + 8 : place + 8 + size])
            place += 8 + size
    except struct.error:
        raise BrokenAsset("is cut short; copy or export it anew") from None
    if length > len(data) or _JSON not in found:
        raise BrokenAsset("is cut short; copy or export it anew")
    return found[_JSON], found.get(_BIN)


def _embedded(uri: str) -> bytes:
    head, separator, text = uri.partition(",")
    if not separator or not head.endswith(";base64") or len(text) > 2 * MOST_BYTES:
        raise BrokenAsset("has embedded data that is not base64; export the model anew")
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise BrokenAsset("has embedded data that is not base64; export the model anew") from None


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
