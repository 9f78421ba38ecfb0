"""Base, part and a result beside them on the page: textured, as plain colours or normals, with their wires.

All in the canonical frame; every method replaces what was there before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.studio.shading import COLOURS, LIT, MATERIALS, NORMALS, OWN, dressed, normals_glb, solid_glb, unlit

if TYPE_CHECKING:
    import viser

_PART = (226, 178, 66)
_LINES = (60, 60, 60)


@dataclass
class _Shown:
    """One object: what it is, and the handles of what is on the page.

    Attributes:
        vertices, faces: (V, 3) canonical and (F, 3), for wires and normals.
        glb: with its materials, user frame; None: clay.
        handle, lines: of viser; the lines once somebody wanted to see them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    glb: bytes | None
    frame: Normalisation
    handle: Any = None
    lines: Any = None


class ShownObjects:
    """Args:
    server: viser's.
    visible: name of an object, or `wireframe` -> whether it is to be seen; changed by its owner, see `apply`.
    """

    def __init__(self, server: viser.ViserServer, visible: dict[str, bool]) -> None:
        self._server, self._scene, self._visible = server, server.scene, visible
        self._shown: dict[str, _Shown] = {}
        self._beside: Any = None
        self._on_base: Callable[[Any], None] | None = None
        self.base_hidden = False
        """Whether the part's GLB has the base in it."""
        self.shading = LIT
        self.material = OWN

    @property
    def has_part(self) -> bool:
        return "part" in self._shown

    def show_base(self, glb: bytes, frame: Normalisation, soup: TriangleMesh) -> None:
        """The base, from a GLB in the user frame; `soup` is the same in the canonical frame."""
        self._show("base", _Shown(soup.vertices, soup.faces, glb, frame))

    def show_part(
        self, vertices: np.ndarray, faces: np.ndarray, frame: Normalisation, glb: bytes | None = None
    ) -> None:
        """The part: vertices (V, 3) canonical, faces (F, 3), and its GLB in the user frame; without one, in clay."""
        self._show("part", _Shown(vertices, faces, glb, frame))

    def show_no_part(self) -> None:
        """Nothing but the base."""
        if (part := self._shown.pop("part", None)) is not None:
            _remove(part)

    def show_beside(self, glb: bytes | None, frame: Normalisation, aside: float = 0.0) -> None:
        """Another result, base and part, beside the first; None: none.

        Args:
            glb: in the user frame.
            aside: how far to the right, canonical units.
        """
        with self._server.atomic():
            if self._beside is not None:
                self._beside.remove()
                self._beside = None
            if glb is not None:
                place = -frame.scale * frame.centre + np.array([aside, 0.0, 0.0])
                self._beside = self._scene.add_glb("/beside", glb, scale=frame.scale, position=place)

    def picking(self, on_base: Callable[[Any], None] | None) -> None:
        """Who hears a click on the base; None: nobody."""
        self._on_base = on_base
        if "base" in self._shown:
            self._listen(self._shown["base"])

    def set_shading(self, kind: str) -> None:
        """Show base and part as one of `shading.SHADINGS`."""
        self.shading = kind
        for name, shown in list(self._shown.items()):
            self._draw(name, shown)

    def set_material(self, name: str) -> None:
        """Show the part in one of `shading.MATERIALS`; not what has been cut, whose base has its own."""
        self.material = name
        if "part" in self._shown:
            self._draw("part", self._shown["part"])

    def apply(self) -> None:
        """Show and hide what `visible` says."""
        for name, shown in self._shown.items():
            solid = self._visible[name] and not (name == "base" and self.base_hidden)
            shown.handle.visible = solid
            wanted = solid and self._visible["wireframe"]
            if wanted and shown.lines is None and len(shown.faces):
                shown.lines = self._scene.add_mesh_simple(
                    f"/{name}_wires", shown.vertices, shown.faces, color=_LINES, wireframe=True
                )
            if shown.lines is not None:
                shown.lines.visible = wanted

    def _show(self, name: str, new: _Shown) -> None:
        before = self._shown.get(name)
        if before is not None and before.lines is not None:
            before.lines.remove()
        self._shown[name] = new
        self._draw(name, new)

    def _draw(self, name: str, shown: _Shown) -> None:
        tried = MATERIALS[self.material] if name == "part" and not self.base_hidden else None
        with self._server.atomic():
            if self.shading == NORMALS:
                shown.handle = self._scene.add_glb(f"/{name}", normals_glb(shown.vertices, shown.faces))
            elif shown.glb is None and tried is not None:
                glb = solid_glb(shown.vertices, shown.faces, tried)
                shown.handle = self._scene.add_glb(f"/{name}", unlit(glb) if self.shading == COLOURS else glb)
            elif shown.glb is None:
                shown.handle = self._scene.add_mesh_simple(
                    f"/{name}", shown.vertices, shown.faces, color=_PART, side="double"
                )
            else:
                frame, glb = shown.frame, shown.glb if tried is None else dressed(shown.glb, tried)
                glb = unlit(glb) if self.shading == COLOURS else glb
                place = -frame.scale * frame.centre
                shown.handle = self._scene.add_glb(f"/{name}", glb, scale=frame.scale, position=place)
            if name == "base":
                self._listen(shown)
            self.apply()

    def _listen(self, base: _Shown) -> None:
        base.handle.remove_click_callback("all")
        if (heard := self._on_base) is not None:
            base.handle.on_click(lambda event: heard(event))


def _remove(shown: _Shown) -> None:
    shown.handle.remove()
    if shown.lines is not None:
        shown.lines.remove()
