"""The format `print`: base and parts as one watertight solid for a 3D printer, as STL and 3MF."""

from __future__ import annotations

import io
import struct
import zipfile
from functools import reduce

import manifold3d
import numpy as np

from fd_mitsuba.config.section import Section
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.formats import EXPORTERS, METRES, ExportContent, Exporter, Unit
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.export.solid.walls import measure_walls
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import topology

_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>"""
_LINKS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>"""


class PrintSettings(Section):
    """Of `print`."""

    unit: Unit | None = None
    """What a unit of the scene is; the files are in millimetres. Default: what the scene says; without that, a unit
    becomes a millimetre."""


@EXPORTERS.register("print", PrintSettings)
class Print(Exporter):
    """`print/asset.stl` and `print/asset.3mf`: the union of base and parts, in millimetres, z upwards."""

    leaves = "print/asset.3mf"

    def write(self, content: ExportContent) -> None:
        unit = self.settings.unit or content.scene.unit
        scale = 1.0 if unit is None else 1000.0 * METRES[unit]
        vertices, faces = _union(content)
        upright = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1) * scale
        content.write("print/asset.stl", stl_bytes(upright, faces))
        content.write(self.leaves, three_mf_bytes(upright, faces))
        sides = " x ".join(f"{side:.4g}" for side in np.ptp(upright, axis=0))
        content.say(f"print: {sides} mm{_walls(content, scale)}")


def _walls(content: ExportContent, scale: float) -> str:
    """The thinnest wall of every part, in words; nothing of parts that are cut out."""
    if content.cut is not None:
        return ""
    scene = content.scene
    base = MeshDistance(scene.frame.to_user(scene.base_canonical.vertices), scene.base_canonical.faces)
    found = {part.name: measure_walls(Solid(part.mesh.vertices, part.mesh.faces), base) for part in content.parts}
    words = [f"; walls of {name!r} from {walls.least * scale:.3g} mm on" for name, walls in found.items() if walls]
    return "".join(words)


def stl_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A binary STL of vertices (V, 3) and faces (F, 3)."""
    corners = vertices[faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    rows = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["normal"], rows["corners"] = normal, corners
    return b"fd_mitsuba, millimetres".ljust(80) + struct.pack("<I", len(faces)) + rows.tobytes()


def three_mf_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A 3MF of one object; the same bytes for the same mesh."""
    points = "".join(f'<vertex x="{x:.7g}" y="{y:.7g}" z="{z:.7g}"/>' for x, y, z in vertices.tolist())
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces.tolist())
    model = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources><object id="1" type="model">'
        f"<mesh><vertices>{points}</vertices><triangles>{triangles}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>'
    )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (("[Content_Types].xml", _TYPES), ("_rels/.rels", _LINKS), ("3D/3dmodel.model", model)):
            archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _union(content: ExportContent) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of one solid, user frame.

    Raises:
        UserError: a base that is not closed.
    """
    base = {shape.name: shape.in_user_frame()[:2] for shape in content.shapes}
    parts = {part.label: (part.mesh.vertices, part.mesh.faces) for part in content.parts}
    if content.cut is not None:  # what a cut leaves and its faces are closed together
        base, parts = base | parts, {}
    pieces = [_pieces(*mesh) for mesh in base.values()]
    if not all(pieces):  # one surface may be several shapes, one a material
        starts = np.cumsum([0] + [len(vertices) for vertices, _ in base.values()])
        faces = np.concatenate([own + start for (_, own), start in zip(base.values(), starts, strict=False)])
        vertices = np.concatenate([vertices for vertices, _ in base.values()])
        pieces = [_pieces(vertices, faces)]
        if not pieces[0]:
            holes = topology(vertices, faces).boundary_edges
            why = f"is not closed ({holes} boundary edges)" if holes else "is no clean solid"
            remedy = "close it, or print assembled.ply of the export, in which holes are filled"
            raise UserError(f"{content.scene.path}: its base {why}, so that it cannot be printed; {remedy}")
    pieces += [_pieces(*mesh) for mesh in parts.values()]
    made = reduce(lambda one, other: one + other, [piece for some in pieces for piece in some]).to_mesh64()
    return np.asarray(made.vert_properties, dtype=np.float64)[:, :3], np.asarray(made.tri_verts, dtype=np.int64)


def _pieces(vertices: np.ndarray, faces: np.ndarray) -> list[manifold3d.Manifold]:
    """The connected solids of a mesh, which may overlap; none where it is no solid."""
    rows, place = np.unique(np.asarray(vertices, np.float64) + 0.0, axis=0, return_inverse=True)
    welded = place.reshape(-1)[faces]
    welded = welded[(np.diff(np.sort(welded, axis=1), axis=1) > 0).all(axis=1)]
    solid = manifold3d.Manifold(manifold3d.Mesh64(rows, np.array(welded, dtype=np.uint64, order="C")))
    return solid.decompose() if solid.status() == manifold3d.Error.NoError and solid.volume() > 0 else []
