"""A metallic-roughness material as the `UsdPreviewSurface` of Universal Scene Description."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from fd_mitsuba.export.gltf import GltfMesh
from fd_mitsuba.export.pictures import Picture


def write_material(stage: Any, path: Any, mesh: GltfMesh, place: Callable[[Picture], str]) -> Any:
    """The material of a mesh at a path of the stage.

    Args:
        place: gives the file of a picture, as the stage is to name it.
    """
    from pxr import Sdf, UsdShade

    kinds, material = Sdf.ValueTypeNames, mesh.material
    made = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    made.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    writer = _Textures(stage, path, place)
    colour = surface.CreateInput("diffuseColor", kinds.Color3f)
    if material.base_picture is not None:
        texture = writer.texture(
            "base_color", material.base_picture, "sRGB", scale=(*material.base_color, material.opacity)
        )
        colour.ConnectToSource(writer.output(texture, "rgb"))
    elif mesh.colours is not None:
        colour.ConnectToSource(writer.output(writer.reader("colours", "float3", "displayColor"), "result", "rgb"))
    else:
        colour.Set(material.base_color)
    if material.orm_picture is not None:
        texture = writer.texture("orm", material.orm_picture, "raw")
        surface.CreateInput("roughness", kinds.Float).ConnectToSource(writer.output(texture, "g"))
        surface.CreateInput("metallic", kinds.Float).ConnectToSource(writer.output(texture, "b"))
    else:
        surface.CreateInput("roughness", kinds.Float).Set(float(material.roughness))
        surface.CreateInput("metallic", kinds.Float).Set(float(material.metallic))
    if material.normal_picture is not None:
        spread = {"scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}  # from [0, 1] to [-1, 1]
        texture = writer.texture("normal", material.normal_picture, "raw", **spread)
        surface.CreateInput("normal", kinds.Normal3f).ConnectToSource(writer.output(texture, "rgb"))
    picture = material.base_picture
    if material.alpha_mode != "OPAQUE" and picture is not None and picture.alpha() is not None:
        alpha = writer.output(writer.shader("base_color"), "a")
        surface.CreateInput("opacity", kinds.Float).ConnectToSource(alpha)
    elif (opacity := material.opacity * (1.0 - material.transmission)) < 1:
        surface.CreateInput("opacity", kinds.Float).Set(float(opacity))
    if material.alpha_mode == "MASK":
        surface.CreateInput("opacityThreshold", kinds.Float).Set(0.5)
    surface.CreateInput("ior", kinds.Float).Set(float(material.ior))
    if material.clearcoat > 0:
        surface.CreateInput("clearcoat", kinds.Float).Set(float(material.clearcoat))
        surface.CreateInput("clearcoatRoughness", kinds.Float).Set(float(material.clearcoat_roughness))
    return made


class _Textures:
    """The nodes of one material that look pictures up."""

    def __init__(self, stage: Any, path: Any, place: Callable[[Picture], str]) -> None:
        self._stage, self._path, self._place = stage, path, place

    def shader(self, name: str) -> Any:
        """The node of that name, which is there already."""
        from pxr import UsdShade

        return UsdShade.Shader.Get(self._stage, self._path.AppendChild(name))

    def output(self, shader: Any, name: str, kind: str = "") -> Any:
        """An output of a node: `rgb`, a single channel, or of another name with its kind said."""
        from pxr import Sdf

        kinds = {"rgb": Sdf.ValueTypeNames.Float3, "uv": Sdf.ValueTypeNames.Float2}
        return shader.CreateOutput(name, kinds.get(kind or name, Sdf.ValueTypeNames.Float))

    def reader(self, name: str, kind: str, primvar: str) -> Any:
        """A node that reads values at vertices, `float2` or `float3`."""
        from pxr import Sdf

        shader = self._define(name, f"UsdPrimvarReader_{kind}")
        shader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
        return shader

    def texture(self, name: str, picture: Picture, colours: str, **numbers: tuple[float, ...]) -> Any:
        """A node that looks a picture up at the mesh's UVs.

        Args:
            colours: "sRGB" or "raw".
            numbers: `scale` and `bias` of what is looked up.
        """
        from pxr import Sdf

        kinds = Sdf.ValueTypeNames
        shader = self._define(name, "UsdUVTexture")
        shader.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(self._place(picture)))
        shader.CreateInput("sourceColorSpace", kinds.Token).Set(colours)
        for key in ("wrapS", "wrapT"):
            shader.CreateInput(key, kinds.Token).Set(picture.wrap)
        for key, values in numbers.items():
            shader.CreateInput(key, kinds.Float4).Set(values)
        shader.CreateInput("st", kinds.Float2).ConnectToSource(self._uvs(name, picture))
        return shader

    def _uvs(self, name: str, picture: Picture) -> Any:
        from pxr import Sdf

        read = self.output(self.reader("st", "float2", "st"), "result", "uv")
        if picture.tiling == ((0.0, 0.0), (1.0, 1.0)) and not picture.rotation:
            return read
        (u, v), scale = picture.tiling
        cosine, sine = math.cos(picture.rotation), math.sin(picture.rotation)
        # There, with v from the top, uv becomes o + R s uv, R by minus the angle; here v runs upwards, so that
        # (u, v') = (u, 1 - v) is first flipped, and flipped back.
        shader = self._define(f"{name}_uv", "UsdTransform2d")
        kinds = Sdf.ValueTypeNames
        shader.CreateInput("in", kinds.Float2).ConnectToSource(read)
        shader.CreateInput("scale", kinds.Float2).Set(scale)
        shader.CreateInput("rotation", kinds.Float).Set(math.degrees(picture.rotation))
        shader.CreateInput("translation", kinds.Float2).Set((u + sine * scale[1], 1 - v - cosine * scale[1]))
        return self.output(shader, "result", "uv")

    def _define(self, name: str, kind: str) -> Any:
        from pxr import UsdShade

        shader = UsdShade.Shader.Define(self._stage, self._path.AppendChild(name))
        shader.CreateIdAttr(kind)
        return shader
