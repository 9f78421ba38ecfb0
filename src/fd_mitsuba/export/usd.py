"""The format `usdz`: one file for what reads Universal Scene Description; needs `usd-core`, which is an extra."""

from __future__ import annotations

import importlib.util
import io
import struct
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.config.section import Section
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.formats import EXPORTERS, METRES, ExportContent, Exporter, Unit, gltf_meshes
from fd_mitsuba.export.gltf import GltfMesh
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.export.usd_material import write_material
from fd_mitsuba.io.safe_text import safe_name

_ALIGNMENT = 64
"""Of what lies in a package, in bytes: it is read where it lies."""


class UsdzSettings(Section):
    """Of `usdz`."""

    unit: Unit | None = None
    """What a unit of the scene is, for the file's `metersPerUnit`. Default: what the scene says; without that, m."""


@EXPORTERS.register("usdz", UsdzSettings)
class Usdz(Exporter):
    """`usd/asset.usdz`: a prim a shape and a part, with `UsdPreviewSurface` materials; needs `fd_mitsuba[usd]`."""

    leaves = "usd/asset.usdz"

    def write(self, content: ExportContent) -> None:
        if importlib.util.find_spec("pxr") is None:
            raise UserError("--format usdz: needs usd-core, an extra; install it by: pip install 'fd_mitsuba[usd]'")
        metres = METRES[self.settings.unit or content.scene.unit or "m"]
        content.write(self.leaves, usdz_bytes(gltf_meshes(content), content.extras, metres))


def usdz_bytes(meshes: list[GltfMesh], about: dict[str, Any], metres: float) -> bytes:
    """A package of the meshes below one prim `/asset`, y upwards.

    Args:
        about: goes to the layer's custom data.
        metres: how many a unit of the meshes is.
    """
    pictures = _Pictures()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "asset.usdc"
        _write_stage(path, meshes, about, metres, pictures)
        return _package({"asset.usdc": path.read_bytes(), **pictures.files})


class _Pictures:
    """The images of a package: path in it -> bytes, each once."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def path(self, picture: Picture) -> str:
        """Where the picture is in the package."""
        for name, data in self.files.items():
            if data == picture.data:
                return name
        taken = [name.rpartition("/")[2] for name in self.files]
        name = f"textures/{safe_name(picture.name, taken, picture.suffix)}"
        self.files[name] = picture.data
        return name


def _write_stage(path: Path, meshes: list[GltfMesh], about: dict[str, Any], metres: float, pictures: _Pictures) -> None:
    from pxr import Kind, Sdf, Tf, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().customLayerData = {key: str(value) for key, value in about.items()}
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    root = UsdGeom.Xform.Define(stage, "/asset")
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root.GetPrim())
    taken: list[str] = ["materials"]
    UsdGeom.Scope.Define(stage, "/asset/materials")
    for mesh in meshes:
        name = safe_name(Tf.MakeValidIdentifier(mesh.name), taken)
        taken.append(name)
        above = "/asset"
        if mesh.parent:
            above = f"/asset/{Tf.MakeValidIdentifier(mesh.parent)}"
            UsdGeom.Xform.Define(stage, above)
            taken.append(above.rpartition("/")[2])
        prim = _write_mesh(stage, f"{above}/{name}", mesh)
        material = write_material(stage, Sdf.Path(f"/asset/materials/{name}"), mesh, pictures.path)
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def _write_mesh(stage: Any, path: str, mesh: GltfMesh) -> Any:
    from pxr import Gf, Sdf, UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, path)
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.ravel(), dtype=np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(axis=0), vertices.max(axis=0)])))
    prim.CreateDoubleSidedAttr(mesh.material.double_sided)
    if mesh.normals is not None:
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, dtype=np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(prim)
    if mesh.uv is not None:
        uv = np.stack([mesh.uv[:, 0], 1.0 - np.asarray(mesh.uv[:, 1], dtype=np.float64)], axis=1)  # v runs upwards
        wanted = Sdf.ValueTypeNames.TexCoord2fArray
        table = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv, dtype=np.float32))
        primvars.CreatePrimvar("st", wanted, UsdGeom.Tokens.vertex).Set(table)
    if mesh.colours is not None:
        tinted = np.asarray(mesh.colours) * np.array(mesh.material.base_color)
        prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(tinted, dtype=np.float32))
        )
    if not np.array_equal(mesh.to_world, np.eye(4)):
        prim.AddTransformOp().Set(Gf.Matrix4d(*np.asarray(mesh.to_world, dtype=np.float64).T.ravel().tolist()))
    return prim


def _package(files: dict[str, bytes]) -> bytes:
    """A ZIP without compression or times, in which every file begins at a multiple of 64 bytes.

    The first one is the layer that is opened.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            entry.external_attr = 0o644 << 16
            head = stream.tell() + 30 + len(name.encode()) + 4  # a local header, and the head of the padding in it
            padding = -head % _ALIGNMENT
            entry.extra = struct.pack("<HH", 0x1986, padding) + bytes(padding)
            archive.writestr(entry, data)
    return stream.getvalue()
